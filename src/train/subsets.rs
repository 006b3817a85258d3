//! Two overlapping subsets of the context views, which share the first and the last view (spec 7.8).

/// Returns the positions of the two subsets of `views` ordered context views at `step`. Both have the first and the last view. Of the views
/// in between, odd positions go to the first subset and even ones to the second; on odd steps it is the other way round. The smaller
/// subset is padded with the last view. Needs at least two views.
pub fn subsets(views: usize, step: u64) -> [Vec<usize>; 2] {
    let last = views - 1;
    let subset = |parity: usize| {
        let middle = (1..last).filter(|position| position % 2 == parity);
        std::iter::once(0).chain(middle).chain([last]).collect::<Vec<_>>()
    };
    let (mut odd, mut even) = (subset(1), subset(0));
    let longer = odd.len().max(even.len());
    odd.resize(longer, last);
    even.resize(longer, last);
    if step.is_multiple_of(2) { [odd, even] } else { [even, odd] }
}

#[cfg(test)]
mod tests {
    use super::subsets;

    #[test]
    fn ends_are_shared_and_the_middle_alternates() {
        assert_eq!(subsets(7, 0), [vec![0, 1, 3, 5, 6], vec![0, 2, 4, 6, 6]]);
        assert_eq!(subsets(7, 1), [vec![0, 2, 4, 6, 6], vec![0, 1, 3, 5, 6]]);
        assert_eq!(subsets(2, 0), [vec![0, 1], vec![0, 1]]);
        assert_eq!(subsets(24, 0).map(|s| s.len()), [13, 13]);
    }
}
