//! Errors of camera poses.

use glam::{DMat3, DMat4, DVec3};

/// Returns the error of each pose in `found` after the similarity that fits them to `truth`: of the position, relative to the largest
/// distance between two of the true cameras, and of the rotation, in degrees.
///
/// The similarity turns by the mean of the rotations between the two; its scale is that of least squares over the positions.
pub fn pose_errors(found: &[DMat4], truth: &[DMat4]) -> Vec<(f64, f64)> {
    let turns = truth.iter().zip(found).map(|(truth, found)| rotation(truth) * rotation(found).transpose());
    let turn = nearest_rotation(turns.fold(DMat3::ZERO, |sum, turn| sum + turn) * (1. / found.len() as f64));
    let centers = |poses: &[DMat4]| poses.iter().map(|pose| pose.w_axis.truncate()).collect::<Vec<DVec3>>();
    let (truths, founds) = (centers(truth), centers(found));
    let mean = |centers: &[DVec3]| centers.iter().sum::<DVec3>() / centers.len() as f64;
    let (mean_truth, mean_found) = (mean(&truths), mean(&founds));
    let turned: Vec<DVec3> = founds.iter().map(|center| turn * (*center - mean_found)).collect();
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
