//! Pairs of photos whose features are matched.

/// Side of the blocks in which pairs are listed: COLMAP keeps the features of few photos in memory.
const BLOCK: usize = 16;

/// Returns all pairs of `count` photos, block by block.
pub(crate) fn exhaustive_pairs(count: usize) -> Vec<(usize, usize)> {
    let mut pairs: Vec<_> =
        (0..count).flat_map(|first| (first + 1..count).map(move |second| (first, second))).collect();
    pairs.sort_by_key(|(first, second)| (first / BLOCK, second / BLOCK));
    pairs
}

/// Returns the pairs of photos in shooting order that are at most `overlap` apart, and every pair among `spread` photos that are spread
/// evenly. The latter connect a path to where it was before; without them COLMAP may place its parts wrongly to each other.
pub(crate) fn sequential_pairs(count: usize, overlap: usize, spread: usize) -> Vec<(usize, usize)> {
    let near = |first: usize| (first + 1..count.min(first + overlap + 1)).map(move |second| (first, second));
    let step = count.div_ceil(spread).max(1);
    let far = exhaustive_pairs(count.div_ceil(step))
        .into_iter()
        .map(|(first, second)| (first * step, second * step));
    (0..count).flat_map(near).chain(far.filter(|(first, second)| second - first > overlap)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_pair_occurs_once() {
        let pairs = exhaustive_pairs(40);
        let distinct: BTreeSet<_> = pairs.iter().collect();
        assert_eq!((pairs.len(), distinct.len()), (780, 780));
        assert!(pairs.iter().all(|(first, second)| first < second && *second < 40));
        // The first block holds the pairs of the first photos.
        assert!(pairs[..120].iter().all(|(_, second)| *second < BLOCK));
    }

    #[test]
    fn sequences_pair_neighbours_and_photos_spread_evenly() {
        let pairs = sequential_pairs(40, 3, 5);
        let of_first: Vec<usize> =
            pairs.iter().filter(|(first, _)| *first == 0).map(|(_, second)| *second).collect();
        assert_eq!(of_first, [1, 2, 3, 8, 16, 24, 32]);
        // 3 neighbours of each photo but the last three, which have 2, 1 and 0; and the pairs of 5.
        assert_eq!(pairs.len(), 37 * 3 + 2 + 1 + 10);
        assert_eq!(pairs.iter().collect::<BTreeSet<_>>().len(), pairs.len());
        assert!(pairs.iter().all(|(first, second)| first < second && *second < 40));
        assert_eq!(sequential_pairs(3, 10, 64), [(0, 1), (0, 2), (1, 2)]);
    }
}
