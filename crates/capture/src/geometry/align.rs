//! Robust alignment of camera centers to positions in metres, such as those of GPS.

use super::Similarity;
use super::eigen::symmetric_eigen;
use fastrand::Rng;
use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// Number of triples of positions that are tried. If half of the positions are outliers, all of them hit one with a probability of 1e-23.
const TRIPLES: usize = 400;
/// Number of times that the similarity is fitted to the inliers of the one before.
const REFITS: usize = 10;
/// Distance of an inlier in terms of the median distance. For normally distributed errors in space, 1 in 500 is farther.
const INLIER: f64 = 2.5;
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
/// Returns `None` for fewer than 3 positions.
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
        inliers = pairs.iter().copied().filter(|pair| distance(&to, pair) <= INLIER * bound).collect();
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
    let (scale_error, up_error) = (2. * along / spread, along / across);
    Some((to, PositionFit { positions, inliers, error, spread, scale_error, up_error }))
}

/// Returns the mean of v vᵀ, row by row.
pub(super) fn covariance(vectors: impl Iterator<Item = DVec3>) -> [[f64; 3]; 3] {
    let (mut sum, mut count) = (DMat3::ZERO, 0.);
    for v in vectors {
        sum += DMat3::from_cols(v * v.x, v * v.y, v * v.z);
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
