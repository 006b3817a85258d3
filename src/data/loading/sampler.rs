//! Choice of the views of a video for a training sample (spec 8.2).

use crate::data::config::{DataConfig, Sampling};
use glam::DVec3;
use rand::seq::index;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

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

/// Draws a random window of the video whose camera centres are `centres`, and from it `context_count` context views and the target views.
/// Returns `None` if the video is shorter than the shortest window. The numbers of views must not exceed that window's length.
pub fn choose_views(
    config: &DataConfig,
    context_count: usize,
    centres: &[DVec3],
    random: &mut impl Rng,
) -> Option<ChosenViews> {
    let [shortest, longest] = config.window;
    if centres.len() < shortest {
        return None;
    }
    let length = random.random_range(shortest..=longest).min(centres.len());
    let start = random.random_range(0..=centres.len() - length);
    let context_positions = match config.sampling {
        Sampling::Uniform => sample_uniform(length, context_count, random),
        Sampling::Farthest => sample_farthest(&centres[start..][..length], context_count, random),
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

/// Farthest point sampling: draws the first of `count` positions at random; each of the others is the one whose centre is farthest from the
/// nearest chosen centre.
fn sample_farthest(centres: &[DVec3], count: usize, random: &mut impl Rng) -> Vec<usize> {
    assert!(count <= centres.len());
    let mut chosen = vec![random.random_range(0..centres.len())];
    // Squared distance of each frame to the nearest chosen one; below 0 for chosen frames.
    let mut squared_distances = vec![f64::INFINITY; centres.len()];
    while chosen.len() < count {
        let last = chosen[chosen.len() - 1];
        for (squared_distance, centre) in squared_distances.iter_mut().zip(centres) {
            *squared_distance = squared_distance.min(centre.distance_squared(centres[last]));
        }
        squared_distances[last] = -1.;
        // Take the first of equally distant frames, so that the result is the same on every machine.
        let farthest = |&a: &usize, &b: &usize| squared_distances[a].total_cmp(&squared_distances[b]);
        chosen.extend((0..centres.len()).rev().max_by(farthest));
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn context_view_counts_are_drawn_per_step() {
        let config = DataConfig { context_views: 12, min_context_views: 4, ..Default::default() };
        let counts: Vec<usize> = (0..2000).map(|step| draw_context_count(&config, 0, step)).collect();
        for count in 4..=12 {
            let occurrences = counts.iter().filter(|&&drawn| drawn == count).count();
            assert!((160..=290).contains(&occurrences), "{count}: {occurrences}");
        }
        assert!(counts.iter().all(|count| (4..=12).contains(count)));
        let always = DataConfig { min_context_views: 0, ..config };
        assert!((0..20).all(|step| draw_context_count(&always, 0, step) == 12));
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
