//! Curve of some hundred points, for a run of any length.

/// Number of points at which adjacent points are merged in pairs. A page with four such curves stays below 100 KB.
const MAX_POINTS: usize = 400;

/// Means over equally many consecutive values. There are always fewer than [`MAX_POINTS`] points.
#[derive(Debug, Default)]
pub(super) struct Series {
    /// Last step, sum and number of values of each point.
    points: Vec<(u64, f64, u64)>,
    /// Base-2 logarithm of the number of values in each point but the last.
    halved: u32,
}

impl Series {
    pub fn push(&mut self, step: u64, value: f64) {
        let whole = 1 << self.halved;
        match self.points.last_mut() {
            Some(last) if last.2 < whole => *last = (step, last.1 + value, last.2 + 1),
            _ => self.points.push((step, value, 1)),
        }
        if self.points.len() == MAX_POINTS {
            let merged = self.points.chunks(2).map(|two| two.iter().copied().reduce(merge));
            self.points = merged.map(|point| point.expect("one or two")).collect();
            self.halved += 1;
        }
    }

    /// Returns the last step and the mean value of each point.
    pub fn points(&self) -> Vec<(u64, f64)> {
        self.points.iter().map(|&(step, sum, count)| (step, sum / count as f64)).collect()
    }
}

fn merge(a: (u64, f64, u64), b: (u64, f64, u64)) -> (u64, f64, u64) {
    (b.0, a.1 + b.1, a.2 + b.2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_run_keeps_its_shape_in_few_points() {
        let mut series = Series::default();
        for step in 0..100_000 {
            series.push(step, step as f64);
        }
        let points = series.points();
        assert!((MAX_POINTS / 2..MAX_POINTS).contains(&points.len()), "{}", points.len());
        assert_eq!(points.last().unwrap().0, 99_999);
        let [first, second] = [points[0], points[1]];
        let count = (first.0 + 1) as f64;
        assert_eq!((first.1, second.1 - first.1), ((count - 1.) / 2., count));
        assert_eq!(series.points.iter().map(|point| point.2).sum::<u64>(), 100_000);
    }

    #[test]
    fn a_short_series_is_not_downsampled() {
        let mut series = Series::default();
        (0..9).for_each(|step| series.push(step, 0.5));
        assert_eq!(series.points(), (0..9).map(|step| (step, 0.5)).collect::<Vec<_>>());
    }
}
