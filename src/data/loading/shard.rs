//! Partition of the samples of a step among processes.

/// One of the equal parts of every step. Together, the parts of a step are the samples that a single process would load.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BatchShard {
    /// Number of samples of a step in this part.
    pub batch: usize,
    /// Index of this part, starting at 0.
    pub number: usize,
    /// Number of parts.
    pub parts: usize,
}

impl BatchShard {
    /// Returns the number of samples of a step in all parts.
    pub fn global_batch_size(self) -> u64 {
        (self.batch * self.parts) as u64
    }

    /// Returns the index of this part's sample number `turn`, where the first step begins with sample `first`.
    pub fn sample(self, first: u64, turn: u64) -> u64 {
        let (step, within) = (turn / self.batch as u64, turn % self.batch as u64);
        first + step * self.global_batch_size() + (self.batch * self.number) as u64 + within
    }

    /// Returns the index of the step of sample number `turn`, computed from the step's first sample. All samples of a step get the
    /// same index, even if a resumed run uses another batch size.
    pub(super) fn step(self, first: u64, turn: u64) -> u64 {
        (first + turn / self.batch as u64 * self.global_batch_size()) / self.global_batch_size()
    }
}

/// Converts a batch size to whole steps of that many samples.
impl From<usize> for BatchShard {
    fn from(batch: usize) -> Self {
        BatchShard { batch, number: 0, parts: 1 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_of_a_step_have_its_index() {
        let whole = BatchShard::from(6);
        assert_eq!((0..12).map(|turn| whole.step(12, turn)).collect::<Vec<_>>(), [[2; 6], [3; 6]].concat());
        // Resumed after steps of 4 samples.
        assert_eq!((0..12).map(|turn| whole.step(8, turn)).collect::<Vec<_>>(), [[1; 6], [2; 6]].concat());
        for number in 0..3 {
            let shard = BatchShard { batch: 2, number, parts: 3 };
            assert_eq!((0..4).map(|turn| shard.step(8, turn)).collect::<Vec<_>>(), [1, 1, 2, 2]);
        }
    }

    #[test]
    fn parts_share_the_samples_of_every_step_out() {
        let whole: Vec<u64> = (0..24).map(|turn| BatchShard::from(6).sample(5, turn)).collect();
        assert_eq!(whole, (5..29).collect::<Vec<_>>());
        for parts in [2, 3, 6] {
            let batch = 6 / parts;
            let of = |number: usize| BatchShard { batch, number, parts };
            for step in 0..4 {
                let turns = (step * batch as u64)..((step + 1) * batch as u64);
                let samples =
                    (0..parts).flat_map(|number| turns.clone().map(move |turn| of(number).sample(5, turn)));
                assert_eq!(samples.collect::<Vec<_>>(), whole[step as usize * 6..][..6], "{parts} parts");
            }
        }
    }
}
