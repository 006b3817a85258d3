//! Robust alignment of camera centers to positions in metres, such as those of GPS.

use super::Similarity;
use super::eigen::symmetric_eigen;
use fastrand::Rng;
use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;

/// Number of triples of positions that are tried. If half of the positions are outliers, all of them hit one with a probability of 1e-23.
const TRIPLES: usize = 400;
/// Number of times that the similarity is fitted to the inliers of the one before.
const REFITS: usize = 10;
/// Distance of an inlier in terms of the median distance. For normally distributed errors in space, 1 in 500 is farther.
const INLIER: f64 = 2.5;
/// Distance in metres of positions that count as exact.
const EXACT: f64 = 1e-3;
/// Minimum number of inliers.
const MIN_INLIERS: usize = 5;
/// Minimum ratio of the positions' spread to their error. Positions that have nothing to do with the cameras have a ratio of about 1.
const MIN_SPREAD: f64 = 4.;

/// How well positions in metres agree with the cameras.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PositionFit {
    /// Number of photos with a position.
    pub positions: usize,
    /// Number of photos whose position agrees with their camera's.
    pub inliers: usize,
    /// Root mean square of the distances between both for these photos, in metres.
    pub error: f64,
    /// Root mean square of the distances of these positions from their mean, in metres.
    pub spread: f64,
    /// Two standard deviations of the scale's relative error.
    pub scale_error: f64,
    /// Standard deviation of the vertical direction's error, in radians. It is large if the positions are on a line.
    pub up_error: f64,
}

impl PositionFit {
    /// Returns `true` if the positions determine the scale: most agree with the cameras, with an error well below their spread.
    pub fn is_reliable(&self) -> bool {
        self.inliers >= MIN_INLIERS
            && 2 * self.inliers > self.positions
            && self.spread > MIN_SPREAD * self.error
    }
}

/// Returns the similarity that maps camera centers to `positions` of the same cameras in metres, of which nearly half may be wrong: the one of those
/// through three of them with the least median distance (Rousseeuw, *Least Median of Squares Regression*, 1984), fitted to its inliers.
/// Returns `None` for fewer than 3 positions, or if those that agree are
/// all the same.
pub fn fit_positions(centers: &[DVec3], positions: &[DVec3]) -> Option<(Similarity, PositionFit)> {
    let pairs: Vec<(DVec3, DVec3)> = centers.iter().copied().zip(positions.iter().copied()).collect();
    if pairs.len() < 3 {
        return None;
    }
    let distance = |to: &Similarity, (from, position): &(DVec3, DVec3)| to.apply(*from).distance(*position);
    let median = |to: &Similarity| {
        let mut distances: Vec<f64> = pairs.iter().map(|pair| distance(to, pair)).collect();
        *distances.select_nth_unstable_by(pairs.len() / 2, f64::total_cmp).1
    };
    let mut random = Rng::with_seed(0);
    let candidates = (0..TRIPLES).map(|_| fit_similarity(&random.choose_multiple(&pairs, 3)));
    let scored = candidates.map(|to| (median(&to), to));
    let (mut bound, mut to) = scored.min_by(|a, b| a.0.total_cmp(&b.0))?;
    let mut inliers = pairs.clone();
    for _ in 0..REFITS {
        inliers =
            pairs.iter().copied().filter(|pair| distance(&to, pair) <= (INLIER * bound).max(EXACT)).collect();
        to = fit_similarity(&inliers);
        bound = median(&to);
    }
    let count = inliers.len() as f64;
    let rms = |squares: f64| (squares / count).sqrt();
    let error = rms(inliers.iter().map(|pair| distance(&to, pair).powi(2)).sum());
    let mean = inliers.iter().map(|pair| pair.1).sum::<DVec3>() / count;
    let covariance = covariance(inliers.iter().map(|pair| pair.1 - mean));
    let spread = rms(inliers.iter().map(|pair| pair.1.distance_squared(mean)).sum());
    // Per axis, errors are 1/√3 of those in space.
    let along = error / (3. * count).sqrt();
    let across = symmetric_eigen(covariance)[1].0.max(0.).sqrt();
    let (positions, inliers) = (pairs.len(), inliers.len());
    if spread == 0. {
        return None;
    }
    // Positions on a line leave any angle.
    let (scale_error, up_error) = (2. * along / spread, (along / across).min(PI));
    Some((to, PositionFit { positions, inliers, error, spread, scale_error, up_error }))
}

/// Returns v vᵀ.
pub(super) fn outer(v: DVec3) -> DMat3 {
    DMat3::from_cols(v * v.x, v * v.y, v * v.z)
}

/// Returns the mean of v vᵀ, row by row.
pub(super) fn covariance(vectors: impl Iterator<Item = DVec3>) -> [[f64; 3]; 3] {
    let (mut sum, mut count) = (DMat3::ZERO, 0.);
    for v in vectors {
        sum += outer(v);
        count += 1.;
    }
    (sum * f64::recip(f64::max(count, 1.))).to_cols_array_2d()
}

/// Returns the similarity with the least squared distances from the first to the second point of every pair: its scale and translation by
/// Umeyama (*Least-squares estimation of transformation parameters between two point patterns*, 1991), its rotation by Horn (*Closed-form
/// solution of absolute orientation using unit quaternions*, 1987).
fn fit_similarity<Pair: std::borrow::Borrow<(DVec3, DVec3)>>(pairs: &[Pair]) -> Similarity {
    let pairs = || pairs.iter().map(|pair| *pair.borrow());
    let count = pairs().count() as f64;
    let (from, to) = pairs().fold((DVec3::ZERO, DVec3::ZERO), |sum, pair| (sum.0 + pair.0, sum.1 + pair.1));
    let (from, to) = (from / count, to / count);
    let mut s = [[0.; 3]; 3];
    let mut square = 0.;
    for (a, b) in pairs().map(|pair| (pair.0 - from, pair.1 - to)) {
        square += a.length_squared();
        (0..3).for_each(|i| (0..3).for_each(|j| s[i][j] += a[i] * b[j]));
    }
    let [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = s;
    let quaternions = symmetric_eigen([
        [xx + yy + zz, yz - zy, zx - xz, xy - yx],
        [yz - zy, xx - yy - zz, xy + yx, zx + xz],
        [zx - xz, xy + yx, yy - xx - zz, yz + zy],
        [xy - yx, zx + xz, yz + zy, zz - xx - yy],
    ]);
    let (product, [w, x, y, z]) = quaternions[3];
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
    let scale = product / square.max(f64::MIN_POSITIVE);
    Similarity { rotation, translation: to - scale * (rotation * from), scale }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns `count` camera centers within ±`extent` units of 2.5 m, and their positions in a turned world with errors of `noise` metres
    /// per axis. One in ten is wrong by up to 300 m.
    fn walk(random: &mut Rng, count: usize, extent: f64, noise: f64) -> (Vec<DVec3>, Vec<DVec3>) {
        let mut signed = || 2. * random.f64() - 1.;
        let turn = DMat3::from_rotation_y(3. * signed()) * DMat3::from_rotation_x(signed());
        let centers: Vec<DVec3> = (0..count)
            .map(|_| DVec3::new(extent * signed(), 0.1 * extent * signed(), extent * signed()))
            .collect();
        let mut position = |(index, center): (usize, &DVec3)| {
            let mut normal = || signed() + signed() + signed();
            let error = noise * DVec3::new(normal(), normal(), normal());
            let wrong = if index % 10 == 3 { 100. } else { 0. };
            2.5 * (turn * *center)
                + DVec3::new(500., -20., 7.)
                + error
                + wrong * DVec3::new(normal(), normal(), 0.)
        };
        let positions = centers.iter().enumerate().map(&mut position).collect();
        (centers, positions)
    }

    #[test]
    fn scales_are_within_their_errors() {
        let mut random = Rng::with_seed(1);
        let mut within = 0;
        for _ in 0..100 {
            let (centers, positions) = walk(&mut random, 40, 12., 2.);
            let (to, fit) = fit_positions(&centers, &positions).unwrap();
            assert!(fit.is_reliable() && (33..=37).contains(&fit.inliers), "{fit:?}");
            assert!((1.8..4.5).contains(&fit.error) && fit.scale_error < 0.06, "{fit:?}");
            within += usize::from((to.scale / 2.5 - 1.).abs() < fit.scale_error);
        }
        // Two standard deviations.
        assert!(within >= 90, "{within} of 100");
    }

    #[test]
    fn exact_positions_give_the_exact_transform() {
        let mut random = Rng::with_seed(2);
        for (count, wrong) in [(6, 1), (12, 1), (24, 3)] {
            let (centers, positions) = walk(&mut random, count, 12., 0.);
            let (to, fit) = fit_positions(&centers, &positions).unwrap();
            assert!(fit.is_reliable() && fit.error < 1e-9 && fit.inliers == count - wrong, "{fit:?}");
            let far = centers.iter().zip(&positions).filter(|(a, b)| to.apply(**a).distance(**b) > 1e-9);
            assert_eq!(far.count(), wrong);
        }
    }

    #[test]
    fn positions_that_have_nothing_to_do_with_the_cameras_are_not_reliable() {
        let mut random = Rng::with_seed(3);
        for _ in 0..20 {
            // Errors of 5 m in a room of 4 m.
            let (centers, positions) = walk(&mut random, 40, 0.8, 5.);
            let (_, fit) = fit_positions(&centers, &positions).unwrap();
            assert!(!fit.is_reliable(), "{fit:?}");
        }
        let (centers, _) = walk(&mut random, 10, 12., 0.);
        assert!(fit_positions(&centers, &[DVec3::ONE; 10]).is_none());
        assert!(!fit_positions(&[DVec3::ONE; 10], &centers).unwrap().1.is_reliable());
        assert!(fit_positions(&centers[..2], &centers[..2]).is_none());
    }

    #[test]
    fn lines_determine_the_scale_but_no_vertical_direction() {
        let mut random = Rng::with_seed(4);
        let (centers, positions) = walk(&mut random, 30, 12., 0.1);
        let (_, wide) = fit_positions(&centers, &positions).unwrap();
        let line: Vec<DVec3> = centers.iter().map(|center| DVec3::X * center.x).collect();
        let noisy: Vec<DVec3> = line
            .iter()
            .map(|center| 2.5 * *center + 0.1 * DVec3::new(random.f64(), random.f64(), random.f64()))
            .collect();
        let (to, fit) = fit_positions(&line, &noisy).unwrap();
        assert!(fit.is_reliable() && (to.scale / 2.5 - 1.).abs() < fit.scale_error, "{fit:?}");
        assert!(wide.up_error < 0.01 && fit.up_error > 0.1, "{wide:?} {fit:?}");
    }
}
