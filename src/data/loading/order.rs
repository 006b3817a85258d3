//! Order in which scenes are trained on. Every epoch visits every scene once, group after group, so that scenes in one file are
//! read together. The scene of a sample follows from the sample's index alone (spec 8.1).

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// Seed modifier that separates the order's random numbers from those of the samples.
const ORDER_KEY: u64 = 0x6f72_6465_725f_6f66;

/// Location of a scene in the data: the index of its group, and its index in that group.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct SceneIndex {
    /// Index of the group.
    pub group: usize,
    /// Index of the scene in the group.
    pub scene: usize,
}

/// A random order of groups of scenes that changes with every epoch.
#[derive(Debug, Clone)]
pub struct Order {
    sizes: Vec<usize>,
    scenes: u64,
    seed: u64,
}

impl Order {
    /// Creates an order of groups with `sizes` scenes each. At least one size must be above 0.
    pub fn new(sizes: Vec<usize>, seed: u64) -> Self {
        let scenes = sizes.iter().sum::<usize>() as u64;
        assert!(scenes > 0, "an order of nothing");
        Order { sizes, scenes, seed }
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_epoch_shows_every_scene_once_and_keeps_groups_together() {
        let order = Order::new(vec![3, 0, 5, 1, 4], 7);
        let epoch = |e: u64| (0..13).map(|i| order.locate(13 * e + i).0).collect::<Vec<_>>();
        for e in 0..20 {
            let shown = epoch(e);
            assert_eq!(shown.iter().collect::<BTreeSet<_>>().len(), 13);
            let changes = shown.windows(2).filter(|pair| pair[0].group != pair[1].group).count();
            assert_eq!(changes, 3, "{shown:?}");
        }
        assert_ne!(epoch(0), epoch(1));
        let other = Order::new(vec![3, 0, 5, 1, 4], 8);
        assert_ne!(epoch(0), (0..13).map(|i| other.locate(i).0).collect::<Vec<_>>());
    }

    #[test]
    fn locate_lists_the_groups_that_follow() {
        let order = Order::new(vec![2, 2, 2], 3);
        let (first, groups) = order.locate(0);
        assert_eq!(groups[0], first.group);
        assert_eq!(groups[1], order.locate(2).0.group);
        assert_eq!(groups[2], order.locate(4).0.group);
        assert_eq!(order.locate(2).1[2], first.group);
    }
}
