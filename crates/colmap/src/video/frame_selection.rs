//! Selects frames of a video by their sharpness and motion. Motion is in units of the image's longer side.

/// Motion from one chosen frame to the next, if it leads to a usual number of frames.
const DEFAULT_MOTION: f64 = 0.06;
/// Number of frames below which [`DEFAULT_MOTION`] is reduced, though not below [`MIN_MOTION`].
const MIN_DEFAULT_FRAMES: usize = 30;
/// Number of frames above which [`DEFAULT_MOTION`] is increased.
const MAX_DEFAULT_FRAMES: usize = 300;
/// Smallest total motion of a moving camera; noise stays below it. Also the smallest spacing of frames by default.
const MIN_MOTION: f64 = 0.01;
/// Smallest motion from one chosen frame to the next, in segments. Without it, two segments could give the frames on either side of
/// their boundary.
const MIN_SPACING: f64 = 1. / 3.;

/// Returns the position of each frame along the path of the image motion, in segments of equal motion. Segment k has the frames at
/// positions in (k, k + 1], at least one.
///
/// `motion[i]` is the motion from frame i - 1 to frame i; `motion[0]` is ignored. The number of segments is `wanted`, or follows from the
/// motion if that is `None`. It is at most the number of frames that moved, and 1 if the total motion is below [`MIN_MOTION`].
pub(super) fn positions(motion: &[f64], wanted: Option<usize>) -> Vec<f64> {
    let moved = motion.iter().skip(1).sum::<f64>() >= MIN_MOTION;
    let Some(start) = motion.iter().skip(1).copied().find(|motion| moved && *motion > 0.) else {
        return vec![1.; motion.len()];
    };
    // Every frame stands for a part of the path, the first one for as much as the next one.
    let motion: Vec<f64> = std::iter::once(start).chain(motion.iter().skip(1).copied()).collect();
    let count = wanted.unwrap_or_else(|| {
        let count = |length| count_segments(&motion, length).round() as usize;
        count(DEFAULT_MOTION).clamp(MIN_DEFAULT_FRAMES.min(count(MIN_MOTION)).max(1), MAX_DEFAULT_FRAMES)
    });
    let length = segment_length(&motion, count);
    let mut position = 0.;
    let step = |motion: f64| {
        position += (motion / length).min(1.);
        position
    };
    motion.into_iter().map(step).collect()
}

/// Returns the number of segments of a `length`. The motion between two adjacent frames counts as one segment at most: there is no frame to
/// divide it at, and after a cut it is unknown. So every segment has a frame.
fn count_segments(motion: &[f64], length: f64) -> f64 {
    motion.iter().map(|motion| (motion / length).min(1.)).sum()
}

/// Returns the length at which `motion` has `count` segments, or the most that it can have.
fn segment_length(motion: &[f64], count: usize) -> f64 {
    let (mut low, mut high) = (0., motion.iter().sum::<f64>());
    // Bisection, to the precision of a float64: the number of segments falls with their length.
    for _ in 0..64 {
        let length = (low + high) / 2.;
        if count_segments(motion, length) > count as f64 { low = length } else { high = length }
    }
    high
}

/// Returns the sharpest frame of each segment, at least [`MIN_SPACING`] from the one before if the segment has such a frame.
pub(super) fn select_frames(positions: &[f64], sharpness: &[f64]) -> Vec<usize> {
    // Larger than the rounding errors of sums.
    let segment_of = |frame: &usize| (positions[*frame] - 1e-6).ceil() as usize;
    let frames: Vec<usize> = (0..positions.len()).collect();
    let mut chosen: Vec<usize> = vec![];
    for segment in frames.chunk_by(|a, b| segment_of(a) == segment_of(b)) {
        let earliest = chosen.last().map_or(0., |frame| positions[*frame] + MIN_SPACING);
        let start = segment.iter().position(|frame| positions[*frame] >= earliest).unwrap_or(0);
        let sharpest = segment[start..].iter().max_by(|a, b| sharpness[**a].total_cmp(&sharpness[**b]));
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
            let chosen = select_frames(&positions(&motion, Some(wanted)), &numbers(500));
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
