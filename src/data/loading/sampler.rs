//! What a sample shows, which follows from its index alone: the scene, by a random order of every epoch (spec 8.1), and the views of its
//! video (spec 8.2); and the samples of each process.

use crate::data::config::{DataConfig, Sampling};
use glam::DVec3;
use rand::seq::{SliceRandom, index};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// Seed modifier that separates the sampler's random numbers from those of the samples.
const ORDER_KEY: u64 = 0x6f72_6465_725f_6f66;

/// Location of a scene in the data: the index of its group, and its index in that group.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct SceneIndex {
    /// Index of the group.
    pub group: usize,
    /// Index of the scene in the group.
    pub scene: usize,
}

/// Sampler of scenes in a random order that changes with every epoch and keeps the scenes of a group together.
#[derive(Debug, Clone)]
pub struct SceneSampler {
    sizes: Vec<usize>,
    scenes: u64,
    seed: u64,
}

impl SceneSampler {
    /// Creates a sampler of groups with `sizes` scenes each. At least one size must be above 0.
    pub fn new(sizes: Vec<usize>, seed: u64) -> Self {
        let scenes = sizes.iter().sum::<usize>() as u64;
        assert!(scenes > 0, "a sampler of nothing");
        SceneSampler { sizes, scenes, seed }
    }

    /// Returns the number of scenes of an epoch.
    pub fn scenes(&self) -> u64 {
        self.scenes
    }

    /// Returns the scene of `sample`, and the groups of its epoch from there on, each of them once.
    pub fn locate(&self, sample: u64) -> (SceneIndex, Vec<usize>) {
        let (epoch, mut position) = (sample / self.scenes, (sample % self.scenes) as usize);
        let mut groups = self.shuffled(self.sizes.len(), epoch, 0);
        let mut turn = 0;
        while position >= self.sizes[groups[turn]] {
            position -= self.sizes[groups[turn]];
            turn += 1;
        }
        groups.rotate_left(turn);
        let group = groups[0];
        let scene = self.shuffled(self.sizes[group], epoch, group as u64 + 1)[position];
        (SceneIndex { group, scene }, groups)
    }

    /// Returns the number of scenes of the group.
    pub fn size(&self, group: usize) -> usize {
        self.sizes[group]
    }

    /// Returns 0 to `count` (exclusive) in a random order of `epoch`. `what` distinguishes the orders of one epoch.
    fn shuffled(&self, count: usize, epoch: u64, what: u64) -> Vec<usize> {
        let mut random = ChaCha8Rng::seed_from_u64(self.seed ^ ORDER_KEY);
        random.set_stream(epoch << 32 | what);
        let mut order: Vec<usize> = (0..count).collect();
        order.shuffle(&mut random);
        order
    }
}

/// The samples that one rank loads of every step. Together, the ranks load the samples that a single process would load.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BatchShard {
    /// Number of samples per step of each rank.
    pub batch_size: usize,
    /// Index of this rank, starting at 0.
    pub rank: usize,
    /// Number of ranks.
    pub world_size: usize,
}

impl BatchShard {
    /// Returns the number of samples of a step on all ranks.
    pub fn global_batch_size(self) -> u64 {
        (self.batch_size * self.world_size) as u64
    }

    /// Returns the index of this rank's sample number `turn`, where the first step begins with sample `first`.
    pub fn sample(self, first: u64, turn: u64) -> u64 {
        let (step, within) = (turn / self.batch_size as u64, turn % self.batch_size as u64);
        first + step * self.global_batch_size() + (self.batch_size * self.rank) as u64 + within
    }

    /// Returns the index of the step of sample number `turn`, computed from the step's first sample. All samples of a step get the
    /// same index, even if a resumed run uses another batch size.
    pub(super) fn step(self, first: u64, turn: u64) -> u64 {
        (first + turn / self.batch_size as u64 * self.global_batch_size()) / self.global_batch_size()
    }
}

/// Converts a batch size to whole steps of that many samples.
impl From<usize> for BatchShard {
    fn from(batch_size: usize) -> Self {
        BatchShard { batch_size, rank: 0, world_size: 1 }
    }
}

/// XORed with the seed for drawing the number of context views.
const CONTEXT_COUNT_SEED: u64 = 0x7669_6577_5f63_6e74;

/// Indices of chosen views in a video, ascending.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChosenViews {
    /// Context views, the input of the model.
    pub context: Vec<usize>,
    /// Target views, which renderings are compared with. They may overlap the context views.
    pub target: Vec<usize>,
}

/// Draws the number of context views of every scene in step `step`.
pub fn draw_context_count(config: &DataConfig, seed: u64, step: u64) -> usize {
    if config.min_context_views == 0 {
        return config.context_views;
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed ^ CONTEXT_COUNT_SEED);
    random.set_stream(step);
    random.random_range(config.min_context_views..=config.context_views)
}

/// Draws a random window of the video whose camera centers are `centers`, and from it `context_count` context views and the target views.
/// Returns `None` if the video is shorter than the shortest window. The numbers of views must not exceed that window's length.
pub fn choose_views(
    config: &DataConfig,
    context_count: usize,
    centers: &[DVec3],
    random: &mut impl Rng,
) -> Option<ChosenViews> {
    let [shortest, longest] = config.window;
    if centers.len() < shortest {
        return None;
    }
    let length = random.random_range(shortest..=longest).min(centers.len());
    let start = random.random_range(0..=centers.len() - length);
    let context_positions = match config.sampling {
        Sampling::Uniform => sample_uniform(length, context_count, random),
        Sampling::Farthest => sample_farthest(&centers[start..][..length], context_count, random),
    };
    let target_positions = sample_uniform(length, config.target_views, random);
    let in_video = |mut positions: Vec<usize>| {
        positions.sort_unstable();
        positions.iter_mut().for_each(|position| *position += start);
        positions
    };
    Some(ChosenViews { context: in_video(context_positions), target: in_video(target_positions) })
}

/// Draws `count` different positions below `length`, all equally likely.
fn sample_uniform(length: usize, count: usize, random: &mut impl Rng) -> Vec<usize> {
    index::sample(random, length, count).into_vec()
}

/// Farthest point sampling: draws the first of `count` positions at random; each of the others is the one whose center is farthest from the
/// nearest chosen center.
fn sample_farthest(centers: &[DVec3], count: usize, random: &mut impl Rng) -> Vec<usize> {
    assert!(count <= centers.len());
    let mut chosen = vec![random.random_range(0..centers.len())];
    // Squared distance of each frame to the nearest chosen one; below 0 for chosen frames.
    let mut squared_distances = vec![f64::INFINITY; centers.len()];
    while chosen.len() < count {
        let last = chosen[chosen.len() - 1];
        for (squared_distance, center) in squared_distances.iter_mut().zip(centers) {
            *squared_distance = squared_distance.min(center.distance_squared(centers[last]));
        }
        squared_distances[last] = -1.;
        // Take the first of equally distant frames, so that the result is the same on every machine.
        let farthest = |&a: &usize, &b: &usize| squared_distances[a].total_cmp(&squared_distances[b]);
        chosen.extend((0..centers.len()).rev().max_by(farthest));
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_epoch_shows_every_scene_once_and_keeps_groups_together() {
        let sampler = SceneSampler::new(vec![3, 0, 5, 1, 4], 7);
        let epoch = |e: u64| (0..13).map(|i| sampler.locate(13 * e + i).0).collect::<Vec<_>>();
        for e in 0..20 {
            let shown = epoch(e);
            assert_eq!(shown.iter().collect::<BTreeSet<_>>().len(), 13);
            let changes = shown.windows(2).filter(|pair| pair[0].group != pair[1].group).count();
            assert_eq!(changes, 3, "{shown:?}");
        }
        assert_ne!(epoch(0), epoch(1));
        let other = SceneSampler::new(vec![3, 0, 5, 1, 4], 8);
        assert_ne!(epoch(0), (0..13).map(|i| other.locate(i).0).collect::<Vec<_>>());
    }

    #[test]
    fn samples_of_a_step_have_its_index() {
        let whole = BatchShard::from(6);
        assert_eq!((0..12).map(|turn| whole.step(12, turn)).collect::<Vec<_>>(), [[2; 6], [3; 6]].concat());
        // Resumed after steps of 4 samples.
        assert_eq!((0..12).map(|turn| whole.step(8, turn)).collect::<Vec<_>>(), [[1; 6], [2; 6]].concat());
        for rank in 0..3 {
            let shard = BatchShard { batch_size: 2, rank, world_size: 3 };
            assert_eq!((0..4).map(|turn| shard.step(8, turn)).collect::<Vec<_>>(), [1, 1, 2, 2]);
        }
    }

    fn config(sampling: Sampling) -> DataConfig {
        DataConfig { window: [40, 220], target_views: 12, sampling, ..Default::default() }
    }

    fn line(count: usize) -> Vec<DVec3> {
        (0..count).map(|i| DVec3::new(i as f64, 0., 0.)).collect()
    }

    fn is_ascending(positions: &[usize]) -> bool {
        positions.windows(2).all(|pair| pair[0] < pair[1])
    }

    #[test]
    fn windows_use_the_whole_range_of_lengths() {
        let mut random = ChaCha8Rng::seed_from_u64(0);
        for sampling in [Sampling::Uniform, Sampling::Farthest] {
            let (mut shortest, mut longest, mut last) = (usize::MAX, 0, 0);
            for _ in 0..2000 {
                let views = choose_views(&config(sampling), 24, &line(300), &mut random).unwrap();
                assert_eq!((views.context.len(), views.target.len()), (24, 12));
                assert!(is_ascending(&views.context) && is_ascending(&views.target));
                let all = || views.context.iter().chain(&views.target);
                let (first_view, last_view) = (*all().min().unwrap(), *all().max().unwrap());
                shortest = shortest.min(last_view - first_view + 1);
                longest = longest.max(last_view - first_view + 1);
                last = last.max(last_view);
            }
            assert!((24..=40).contains(&shortest), "{shortest}");
            assert!((200..=220).contains(&longest), "{longest}");
            assert!(last > 290, "{last}");
        }
    }

    #[test]
    fn a_short_clip_is_its_own_window_and_a_shorter_one_is_skipped() {
        let mut random = ChaCha8Rng::seed_from_u64(0);
        assert_eq!(choose_views(&config(Sampling::Uniform), 24, &line(39), &mut random), None);
        let views = choose_views(&config(Sampling::Uniform), 24, &line(40), &mut random).unwrap();
        assert!(views.context.iter().all(|&view| view < 40));
    }

    #[test]
    fn farthest_views_are_spread_over_the_window() {
        let mut random = ChaCha8Rng::seed_from_u64(0);
        let config = DataConfig {
            window: [64, 64],
            target_views: 1,
            sampling: Sampling::Farthest,
            ..Default::default()
        };
        for _ in 0..50 {
            let context = choose_views(&config, 9, &line(64), &mut random).unwrap().context;
            assert!(context[0] <= 10 && context[8] >= 53, "{context:?}");
            let widest = context.windows(2).map(|pair| pair[1] - pair[0]).max();
            assert!(widest <= Some(16), "{context:?}");
        }
        // Cameras at the same position must not break the choice.
        let still = choose_views(&config, 9, &[DVec3::ONE; 64], &mut random).unwrap();
        assert!(is_ascending(&still.context));
    }
}
