//! Choice of frames by their sharpness and motion. Motion is in units of the picture's longer side.

/// Motion from one chosen frame to the next, if it leads to a usual number of frames.
const USUAL_MOTION: f64 = 0.06;
/// Number of frames below which [`USUAL_MOTION`] is reduced, though not below [`LEAST_MOTION`].
const MIN_FRAMES: usize = 30;
/// Number of frames above which [`USUAL_MOTION`] is increased.
const MAX_FRAMES: usize = 300;
/// Motion that neither noise nor a camera on a tripod causes.
const LEAST_MOTION: f64 = 0.01;
/// Smallest motion from one chosen frame to the next, in stretches. Without it, two stretches could give the frames on either side of
/// their boundary.
const MIN_SPACING: f64 = 1. / 3.;

/// Returns the position of each frame on the path that the picture moves, in stretches: stretch k has the positions from above k to k + 1,
/// and at least one frame.
///
/// `motion` is how far the picture moves from the frame before to each frame; the first value doesn't count. The number of stretches is
/// `wanted`, or what suits the motion; but not more than the frames between which the picture moves, and 1 if it doesn't move at all.
pub(super) fn positions(motion: &[f64], wanted: Option<usize>) -> Vec<f64> {
    let Some(start) = motion.iter().skip(1).copied().find(|motion| *motion > 0.) else {
        return vec![1.; motion.len()];
    };
    if motion.iter().skip(1).sum::<f64>() < LEAST_MOTION {
        return vec![1.; motion.len()];
    }
    // Every frame stands for a part of the path, the first one for as much as the next one.
    let motion: Vec<f64> = std::iter::once(start).chain(motion.iter().skip(1).copied()).collect();
    let count = wanted.unwrap_or_else(|| {
        let count = |length| count_stretches(&motion, length).round() as usize;
        count(USUAL_MOTION).clamp(MIN_FRAMES.min(count(LEAST_MOTION)).max(1), MAX_FRAMES)
    });
    let length = stretch_length(&motion, count);
    let mut position = 0.;
    let step = |motion: f64| {
        position += (motion / length).min(1.);
        position
    };
    motion.into_iter().map(step).collect()
}

/// Returns the number of stretches of a `length`. Motion from one frame to the next counts as one stretch at most, because it can't be
/// divided, and that of a cut isn't known. This gives every stretch a frame.
fn count_stretches(motion: &[f64], length: f64) -> f64 {
    motion.iter().map(|motion| (motion / length).min(1.)).sum()
}

/// Returns the length at which `motion` has `count` stretches, or the most that it can have.
fn stretch_length(motion: &[f64], count: usize) -> f64 {
    let (mut low, mut high) = (0., motion.iter().sum::<f64>());
    // Bisection, to the precision of a float64: the number of stretches falls with their length.
    for _ in 0..64 {
        let length = (low + high) / 2.;
        if count_stretches(motion, length) > count as f64 { low = length } else { high = length }
    }
    high
}

/// Returns the sharpest frame of each stretch, at least [`MIN_SPACING`] from the one before if the stretch has such a frame.
pub(super) fn choose_frames(positions: &[f64], sharpness: &[f64]) -> Vec<usize> {
    // Larger than the rounding errors of sums.
    let stretch_of = |frame: &usize| (positions[*frame] - 1e-6).ceil() as usize;
    let frames: Vec<usize> = (0..positions.len()).collect();
    let mut chosen: Vec<usize> = vec![];
    for stretch in frames.chunk_by(|a, b| stretch_of(a) == stretch_of(b)) {
        let earliest = chosen.last().map_or(0., |frame| positions[*frame] + MIN_SPACING);
        let start = stretch.iter().position(|frame| positions[*frame] >= earliest).unwrap_or(0);
        let sharpest = stretch[start..].iter().max_by(|a, b| sharpness[**a].total_cmp(&sharpness[**b]));
        chosen.extend(sharpest);
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns `count` numbers in [0, 1), always the same ones.
    fn numbers(count: usize) -> Vec<f64> {
        (1..=count).map(|i| (i as f64 * 0.618_033_988_7 + (i * i) as f64 * 0.137).fract()).collect()
    }

    #[test]
    fn the_number_of_frames_is_exact() {
        let motion: Vec<f64> = numbers(500).iter().map(|x| if *x < 0.4 { 0. } else { x * x * 0.1 }).collect();
        let moving = 1 + motion[1..].iter().filter(|motion| **motion > 0.).count();
        for wanted in (1..=moving).chain([moving + 1, 2000]) {
            let chosen = choose_frames(&positions(&motion, Some(wanted)), &numbers(500));
            assert_eq!(chosen.len(), wanted.min(moving));
            assert!(chosen.is_sorted_by(|a, b| a < b));
        }
    }

    #[test]
    fn the_usual_number_of_frames_suits_the_motion() {
        let count =
            |frames: usize, motion: f64| positions(&vec![motion; frames], None).last().unwrap().round();
        // 0.06 between frames, if these are 30 to 300.
        assert_eq!(count(1000, 0.006), 100.);
        assert_eq!(count(100, 0.006), 30.);
        assert_eq!(count(10_000, 0.006), 300.);
        // 30 frames would be less than 0.01 apart.
        assert_eq!(count(100, 0.001), 10.);
        // A camera at rest.
        assert_eq!(count(100, 0.00001), 1.);
        assert_eq!(count(100, 0.), 1.);
    }
}
