//! Errors of camera poses.

use glam::{DMat3, DMat4, DVec3};

/// Returns the error of each pose in `found` after the similarity that fits them to `truth`: of the position, relative to the largest
/// distance between two of the true cameras, and of the rotation, in degrees.
///
/// The similarity turns by the mean of the rotations between the two; its scale is that of least squares over the positions.
pub fn pose_errors(found: &[DMat4], truth: &[DMat4]) -> Vec<(f64, f64)> {
    let turns = truth.iter().zip(found).map(|(truth, found)| rotation(truth) * rotation(found).transpose());
    let turn = nearest_rotation(turns.fold(DMat3::ZERO, |sum, turn| sum + turn) * (1. / found.len() as f64));
    let centres = |poses: &[DMat4]| poses.iter().map(|pose| pose.w_axis.truncate()).collect::<Vec<DVec3>>();
    let (truths, founds) = (centres(truth), centres(found));
    let mean = |centres: &[DVec3]| centres.iter().sum::<DVec3>() / centres.len() as f64;
    let (mean_truth, mean_found) = (mean(&truths), mean(&founds));
    let turned: Vec<DVec3> = founds.iter().map(|centre| turn * (*centre - mean_found)).collect();
    let products =
        turned.iter().zip(&truths).map(|(found, truth)| found.dot(*truth - mean_truth)).sum::<f64>();
    let scale = products / turned.iter().map(|found| found.length_squared()).sum::<f64>();
    let size = truths.iter().flat_map(|a| truths.iter().map(move |b| a.distance(*b))).fold(0., f64::max);
    let positions = turned
        .iter()
        .zip(&truths)
        .map(|(found, truth)| (scale * *found + mean_truth).distance(*truth) / size);
    let angles = truth.iter().zip(found).map(|(truth, found)| {
        let rest = rotation(truth).transpose() * turn * rotation(found);
        ((rest.x_axis.x + rest.y_axis.y + rest.z_axis.z - 1.) / 2.).clamp(-1., 1.).acos().to_degrees()
    });
    positions.zip(angles).collect()
}

fn rotation(pose: &DMat4) -> DMat3 {
    DMat3::from_mat4(*pose)
}

/// Returns the nearest rotation, by Newton's iteration for the polar decomposition.
fn nearest_rotation(sum: DMat3) -> DMat3 {
    (0..30).fold(sum, |x, _| (x + x.inverse().transpose()) * 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_those_left_by_a_similarity() {
        let pose = |i: usize| {
            let i = i as f64;
            DMat4::from_translation(DVec3::new(i, (2. * i).sin(), (3. * i).cos()))
                * DMat4::from_rotation_y(0.2 * i)
        };
        let truth: Vec<DMat4> = (0..40).map(pose).collect();
        let moved = |pose: &DMat4| {
            let motion = DMat4::from_translation(DVec3::new(3., -1., 2.)) * DMat4::from_rotation_x(2.);
            let mut moved = motion * *pose;
            moved.w_axis = (2.5 * moved.w_axis.truncate()).extend(1.);
            moved
        };
        let mut found: Vec<DMat4> = truth.iter().map(moved).collect();
        let is_zero = |&(position, angle): &(f64, f64)| position < 1e-12 && angle < 1e-5;
        assert!(pose_errors(&found, &truth).iter().all(is_zero));
        found[20] *= DMat4::from_translation(DVec3::X) * DMat4::from_rotation_z(0.1);
        let (position, angle) = pose_errors(&found, &truth)[20];
        // One camera of 40 moves the fit a little.
        assert!((position / (0.4 / 39.) - 1.).abs() < 0.06, "{position}");
        assert!((angle / 0.1f64.to_degrees() - 1.).abs() < 0.06, "{angle}");
    }
}
