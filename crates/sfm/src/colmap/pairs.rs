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

/// Returns the pairs of photos in shooting order that are at most `overlap` apart, or a power of two: the latter connect a path that
/// returns to where it was.
pub(crate) fn sequential_pairs(count: usize, overlap: usize) -> Vec<(usize, usize)> {
    let far = (0..usize::BITS).map(|power| 1 << power).filter(|&distance| distance > overlap);
    let distances: Vec<usize> = (1..=overlap).chain(far).take_while(|&distance| distance < count).collect();
    (0..count)
        .flat_map(|first| distances.iter().map(move |distance| (first, first + distance)))
        .filter(|(_, second)| *second < count)
        .collect()
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
    fn sequences_pair_neighbours_and_powers_of_two() {
        let pairs = sequential_pairs(40, 3);
        let of_first: Vec<usize> =
            pairs.iter().filter(|(first, _)| *first == 0).map(|(_, second)| *second).collect();
        assert_eq!(of_first, [1, 2, 3, 4, 8, 16, 32]);
        assert_eq!(pairs.last(), Some(&(38, 39)));
        assert_eq!(sequential_pairs(3, 10), [(0, 1), (0, 2), (1, 2)]);
    }
}
