//! Selection of the context views of a capture that a model sees: fewer than there are, which still cover the scene (spec 9.7).

use crate::data::{Capture, Holdout, View, load_views};
use crate::error::{Error, Result};
use crate::scene::{Camera, ImageSize};

/// Loads the context views of a capture, fitted to `size`: the views that `holdout` doesn't hold out. If `views` is given, at most so many
/// of them are loaded, spread over the camera path.
///
/// # Errors
/// Fails if a photo can't be read, or if every photo is masked out as a whole.
pub fn load_context(
    capture: &Capture,
    holdout: Holdout,
    views: Option<usize>,
    size: ImageSize,
) -> Result<Vec<View>> {
    let views = load_views(capture, &context_views(capture, holdout, views), Some(size))?;
    if views.iter().all(View::is_masked_out) {
        return Err(Error::input(
            capture.file(),
            "the masks",
            "no pixel that counts",
            "white where a photo counts",
        ));
    }
    Ok(views)
}

/// Returns the indices of the views that [`load_context`] loads.
pub fn context_views(capture: &Capture, holdout: Holdout, views: Option<usize>) -> Vec<usize> {
    let (shown, _) = capture.split(holdout);
    match views {
        Some(views) => spread_over_path(&capture.cameras(), &shown, views),
        None => shown,
    }
}

/// Selects `wanted` of `indices` into `cameras`: the first, the last, and others at even distances along the camera path, so that a camera
/// that stays in one position doesn't use up the selection. Returns all of them if there are no more than `wanted`.
///
/// A path of length 1 crosses the scene's extent, or turns by one radian.
pub fn spread_over_path(cameras: &[Camera], indices: &[usize], wanted: usize) -> Vec<usize> {
    let count = indices.len();
    if count <= wanted {
        return indices.to_vec();
    }
    if wanted == 1 {
        return vec![indices[count / 2]];
    }
    let pose = |i: usize| cameras[indices[i]].c2w;
    let center = |i: usize| pose(i).w_axis.truncate();
    let extent = (1..count).map(|i| center(i).distance(center(0))).fold(0., f64::max);
    let step = |i: usize| {
        let moved = if extent > 0. { center(i).distance(center(i - 1)) / extent } else { 0. };
        moved + pose(i).z_axis.truncate().angle_between(pose(i - 1).z_axis.truncate())
    };
    let mut position = vec![0.; count];
    for i in 1..count {
        position[i] = position[i - 1] + step(i);
    }
    let length = position[count - 1];
    let mut chosen = vec![0];
    for k in 1..wanted {
        // Candidates come after the last selected index and leave one for each selection still to come.
        let open = chosen[k - 1] + 1..=count - (wanted - k);
        // Cameras that don't move at all are spread by index.
        let off = |i: usize| match length > 0. {
            true => (position[i] - length * k as f64 / (wanted - 1) as f64).abs(),
            false => (i as f64 - ((count - 1) * k) as f64 / (wanted - 1) as f64).abs(),
        };
        let nearest = open.min_by(|&a, &b| off(a).total_cmp(&off(b))).expect("one is left");
        chosen.push(nearest);
    }
    *chosen.last_mut().expect("two at least") = count - 1;
    chosen.into_iter().map(|i| indices[i]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;
    use glam::{DMat4, DVec3};

    fn cameras(poses: impl Iterator<Item = DMat4>) -> Vec<Camera> {
        let intrinsics = Intrinsics { fx: 1., fy: 1., cx: 0.5, cy: 0.5 };
        poses.map(|c2w| Camera { intrinsics, c2w, width: 1, height: 1 }).collect()
    }

    fn along(positions: &[f64]) -> Vec<Camera> {
        cameras(positions.iter().map(|&x| DMat4::from_translation(DVec3::X * x)))
    }

    #[test]
    fn views_are_spread_from_first_to_last() {
        let even = along(&(0..20).map(f64::from).collect::<Vec<_>>());
        let indices: Vec<usize> = (10..20).collect();
        assert_eq!(spread_over_path(&even, &indices, 4), [10, 13, 16, 19]);
        assert_eq!(spread_over_path(&even, &indices, 20), indices);
        assert_eq!(spread_over_path(&even, &indices, 1), [15]);
    }

    #[test]
    fn a_camera_that_rests_is_chosen_once() {
        let rests = along(&[0., 0., 0., 0., 0., 1., 2., 3., 4.]);
        let all: Vec<usize> = (0..9).collect();
        assert_eq!(spread_over_path(&rests, &all, 5), [0, 5, 6, 7, 8]);
        assert_eq!(spread_over_path(&rests, &all, 3), [0, 6, 8]);
        assert_eq!(spread_over_path(&along(&[1.; 9]), &all, 3), [0, 4, 8]);
    }

    #[test]
    fn a_camera_that_turns_moves_too() {
        let turns = cameras([0., 0., 0., 0.5, 1.].into_iter().map(DMat4::from_rotation_y));
        assert_eq!(spread_over_path(&turns, &[0, 1, 2, 3, 4], 3), [0, 3, 4]);
    }
}
