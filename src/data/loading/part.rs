//! Which samples of every step a process loads.

/// One of equal parts of every step. The parts of a step together are the samples that a process alone would load.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Part {
    /// Samples of a step in this part.
    pub batch: usize,
    /// Which part it is, from 0.
    pub number: usize,
    /// Of so many.
    pub parts: usize,
}

impl Part {
    /// Samples of a step in all parts.
    pub fn of_step(self) -> u64 {
        (self.batch * self.parts) as u64
    }

    /// The number of the sample that comes in this part's turn `turn`, of steps from sample `first` on.
    pub fn sample(self, first: u64, turn: u64) -> u64 {
        let (step, within) = (turn / self.batch as u64, turn % self.batch as u64);
        first + step * self.of_step() + (self.batch * self.number) as u64 + within
    }

    /// The number of that turn's step, by the sample that it begins with: the same for all of its samples, wherever a run goes on with
    /// another number of them.
    pub(super) fn step(self, first: u64, turn: u64) -> u64 {
        (first + turn / self.batch as u64 * self.of_step()) / self.of_step()
    }
}

/// Whole steps of so many samples.
impl From<usize> for Part {
    fn from(batch: usize) -> Self {
        Part { batch, number: 0, parts: 1 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_samples_of_a_step_know_it() {
        let whole = Part::from(6);
        assert_eq!((0..12).map(|turn| whole.step(12, turn)).collect::<Vec<_>>(), [[2; 6], [3; 6]].concat());
        // Begun where steps of 4 ended.
        assert_eq!((0..12).map(|turn| whole.step(8, turn)).collect::<Vec<_>>(), [[1; 6], [2; 6]].concat());
        for number in 0..3 {
            let part = Part { batch: 2, number, parts: 3 };
            assert_eq!((0..4).map(|turn| part.step(8, turn)).collect::<Vec<_>>(), [1, 1, 2, 2]);
        }
    }

    #[test]
    fn parts_share_the_samples_of_every_step_out() {
        let whole: Vec<u64> = (0..24).map(|turn| Part::from(6).sample(5, turn)).collect();
        assert_eq!(whole, (5..29).collect::<Vec<_>>());
        for parts in [2, 3, 6] {
            let batch = 6 / parts;
            let of = |number: usize| Part { batch, number, parts };
            for step in 0..4 {
                let turns = (step * batch as u64)..((step + 1) * batch as u64);
                let of_step =
                    (0..parts).flat_map(|number| turns.clone().map(move |turn| of(number).sample(5, turn)));
                assert_eq!(of_step.collect::<Vec<_>>(), whole[step as usize * 6..][..6], "{parts} parts");
            }
        }
    }
}
