//! Exposures of photos relative to each other, measured where photos show the same surface, as panoramas are balanced (Brown and Lowe 2007).

use super::options::ExposureCorrection;
use crate::scene::Camera;
use crate::stereo::{DepthMap, SmallPhoto, nearest_to, numbers, pixel_and_depth, truths};
use glam::DVec3;
use std::ops::Range;
use tch::Tensor;

/// Maximum number of a photo's points at which other photos are compared with it.
const MAX_POINTS: usize = 1000;
/// Minimum number of points that two photos have to share.
const MIN_POINTS: usize = 50;
/// Values of a photo that are neither so dark that their ratios are inexact nor saturated.
const USABLE: Range<f32> = 0.05..0.95;
/// Maximum relative difference of a point's depth from the depth of the photo that shows it: farther points are occluded.
const SAME_SURFACE: f64 = 0.1;
/// Median absolute deviation of the logarithms of ratios at which the weight of a comparison is halved.
const NOISE: f64 = 0.02;
/// Weight of the prior that the logarithm of a gain is 0, relative to a comparison at [`MAX_POINTS`] points. It decides where photos share
/// nothing.
const PRIOR: f64 = 1e-3;
/// Root mean square of the logarithms of gains below which a correction changes nothing visible.
const MIN_DIFFERENCE: f64 = 0.02;

/// Natural logarithms of the gains of red, green and blue.
pub(super) type LogGains = [f64; 3];

/// Photo that points are compared with.
struct ExposedPhoto<'a> {
    photo: &'a SmallPhoto,
    colors: Vec<f32>,
    counted: Option<Vec<bool>>,
    /// Depth of each pixel on which the photos agree, infinity for others; `None` if the photo has no depth map.
    depths: Option<Vec<f32>>,
}

/// Ratio of the exposures of two photos.
struct Ratio {
    log: LogGains,
    /// Weight of the comparison, at most 1.
    weight: f64,
}

/// Measures the exposures of `photos`, whose mean is 0. `depth_maps` are the depths of some of them, with their indices.
fn measure_exposures(photos: &[SmallPhoto], depth_maps: &[(usize, DepthMap)]) -> Vec<LogGains> {
    let mut exposed: Vec<ExposedPhoto> = photos.iter().map(ExposedPhoto::new).collect();
    for (index, map) in depth_maps {
        exposed[*index].depths = Some(map.sure_depths());
    }
    // Ratios of all photos to each photo that has a depth map.
    let ratios = depth_maps.iter().map(|(index, _)| {
        let points = exposed[*index].points();
        exposed.iter().map(|photo| photo.ratio_to(&points)).collect()
    });
    let ratios: Vec<Vec<Option<Ratio>>> = ratios.collect();
    let indices: Vec<usize> = depth_maps.iter().map(|(index, _)| *index).collect();
    let of_maps = balance(&ratios, &indices);
    let gains = (0..photos.len()).map(|photo| match indices.binary_search(&photo) {
        Ok(row) => of_maps[row],
        Err(_) => {
            let (mut sums, mut weights) = ([0.; 3], PRIOR);
            for (row, gains) in ratios.iter().zip(&of_maps) {
                let Some(Ratio { log, weight }) = &row[photo] else { continue };
                weights += weight;
                (0..3).for_each(|c| sums[c] += weight * (gains[c] + log[c]));
            }
            sums.map(|sum| sum / weights)
        }
    });
    let gains: Vec<LogGains> = gains.collect();
    let mean = [0, 1, 2].map(|c| gains.iter().map(|gain| gain[c]).sum::<f64>() / gains.len() as f64);
    gains.iter().map(|gain| [0, 1, 2].map(|c| gain[c] - mean[c])).collect()
}

/// Measures the exposures of `photos` like [`measure_exposures`]; returns `None` if they are not to be corrected on `condition`.
pub(super) fn correct_exposures(
    condition: ExposureCorrection,
    photos: &[SmallPhoto],
    depth_maps: &[(usize, DepthMap)],
) -> Option<Vec<LogGains>> {
    if condition == ExposureCorrection::Off {
        return None;
    }
    let gains = measure_exposures(photos, depth_maps);
    let cameras: Vec<Camera> = photos.iter().map(|photo| photo.camera).collect();
    (condition == ExposureCorrection::On || are_uneven(&gains, &cameras)).then_some(gains)
}

/// Returns whether the exposures of nearby photos differ more from each other than from the mean.
fn are_uneven(gains: &[LogGains], cameras: &[Camera]) -> bool {
    let squares = |a: LogGains, b: LogGains| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>();
    let from_mean: f64 = gains.iter().map(|&gain| squares(gain, [0.; 3])).sum();
    let nearest = (0..gains.len()).filter_map(|index| Some((index, nearest_to(index, cameras)?)));
    let from_nearest: f64 = nearest.map(|(index, other)| squares(gains[index], gains[other])).sum();
    let count = gains.len() as f64;
    from_mean > 3. * count * MIN_DIFFERENCE.powi(2) && from_nearest * (count - 1.) > from_mean * count
}

/// Returns the gains of the photos `indices` that fit their ratios best, by weighted least squares. `ratios` has the ratios of all photos to
/// each of these.
fn balance(ratios: &[Vec<Option<Ratio>>], indices: &[usize]) -> Vec<LogGains> {
    let n = indices.len();
    let (mut matrix, mut right) = (vec![0.; n * n], vec![0.; n * 3]);
    for (i, row) in ratios.iter().enumerate() {
        matrix[i * n + i] += PRIOR;
        for (j, &photo) in indices.iter().enumerate() {
            // The gain of photo j minus that of photo i is their ratio.
            let Some(Ratio { log, weight }) = &row[photo] else { continue };
            for (row, sign) in [(i, -1.), (j, 1.)] {
                matrix[row * n + i] -= sign * weight;
                matrix[row * n + j] += sign * weight;
                (0..3).for_each(|c| right[row * 3 + c] += sign * weight * log[c]);
            }
        }
    }
    let of = |values: &[f64], columns: usize| Tensor::from_slice(values).view([n as i64, columns as i64]);
    let solution = Tensor::linalg_solve(&of(&matrix, n), &of(&right, 3), true);
    let numbers = Vec::<f64>::try_from(solution.contiguous().view([-1])).expect("numbers");
    numbers.as_chunks().0.to_vec()
}

impl<'a> ExposedPhoto<'a> {
    fn new(photo: &'a SmallPhoto) -> Self {
        let counted = photo.counted().as_ref().map(truths);
        ExposedPhoto { photo, colors: numbers(&photo.image), counted, depths: None }
    }

    /// Returns the color of a pixel that counts and is neither too dark nor too bright.
    fn color(&self, pixel: usize) -> Option<[f32; 3]> {
        let [h, w] = self.photo.size().map(|side| side as usize);
        let color = [0, 1, 2].map(|c| self.colors[c * h * w + pixel]);
        let is_counted = self.counted.as_ref().is_none_or(|counted| counted[pixel]);
        (is_counted && color.iter().all(|value| USABLE.contains(value))).then_some(color)
    }

    /// Returns points of the surfaces that the photo shows, and their colors. Requires a depth map.
    fn points(&self) -> Vec<(DVec3, [f32; 3])> {
        let camera = self.photo.camera;
        let depths = self.depths.as_ref().expect("depths");
        let point = |(pixel, &depth): (usize, &f32)| {
            let color = self.color(pixel).filter(|_| depth.is_finite())?;
            let [u, v] =
                [pixel as u32 % camera.width, pixel as u32 / camera.width].map(|side| f64::from(side) + 0.5);
            Some((camera.unproject(u, v, depth.into()), color))
        };
        let points: Vec<_> = depths.iter().enumerate().filter_map(point).collect();
        let every = points.len().div_ceil(MAX_POINTS).max(1);
        points.into_iter().step_by(every).collect()
    }

    /// Returns the median ratio of this photo's colors to those of `points`; `None` if it shows too few of them.
    fn ratio_to(&self, points: &[(DVec3, [f32; 3])]) -> Option<Ratio> {
        let seen = pixel_and_depth(&self.photo.camera);
        let mut logs: [Vec<f32>; 3] = Default::default();
        for (point, color) in points {
            let Some((pixel, z)) = seen(*point) else { continue };
            let is_surface = |depths: &Vec<f32>| (z / f64::from(depths[pixel]) - 1.).abs() < SAME_SURFACE;
            if let Some(shown) = self.color(pixel).filter(|_| self.depths.as_ref().is_none_or(is_surface)) {
                (0..3).for_each(|c| logs[c].push((shown[c] / color[c]).ln()));
            }
        }
        let count = logs[0].len();
        if count < MIN_POINTS {
            return None;
        }
        let (mut log, mut spread) = ([0.; 3], 0.);
        for (log, logs) in log.iter_mut().zip(&mut logs) {
            let middle = median(logs);
            logs.iter_mut().for_each(|log| *log = (*log - middle).abs());
            *log = f64::from(middle);
            spread += f64::from(median(logs)) / 3.;
        }
        Some(Ratio { log, weight: count as f64 / MAX_POINTS as f64 / (1. + (spread / NOISE).powi(2)) })
    }
}

fn median(values: &mut [f32]) -> f32 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::View;
    use crate::refine::{PhotoInit, gaussians_from_photos};
    use crate::scene::SH_C0;
    use crate::stereo::SWEEP_SIDE;
    use tch::Kind;

    const DEPTH: f64 = 4.;

    /// Returns the view of a camera at `x` on a wall, multiplied by `gains`.
    fn wall(x: f64, gains: [f64; 3]) -> View {
        let view = crate::data::wall(x);
        let gains = Tensor::from_slice(&gains).to_kind(Kind::Float).view([3, 1, 1]);
        View { image: (view.image.to_float() * gains).into(), ..view }
    }

    /// Gains are measured of photos with and without a depth map, and 0 is assumed for one that shares nothing with the others.
    #[test]
    fn exposures_are_measured() {
        let gains = [[1., 1., 1.], [0.8, 0.9, 1.1], [1.3, 1.2, 1.4], [1., 1., 1.]];
        let views: Vec<View> = [-0.5, 0., 0.5, 90.].into_iter().zip(gains).map(|(x, g)| wall(x, g)).collect();
        let photos: Vec<SmallPhoto> = views.iter().map(|view| view.to_small_photo(128.)).collect();
        let map = |index: usize| {
            let map = DepthMap { camera: photos[index].camera, ..DepthMap::flat(64, 64, DEPTH) };
            (index, map)
        };
        let found = measure_exposures(&photos, &[map(0), map(2)]);
        for c in 0..3 {
            let logs = gains.map(|gain: [f64; 3]| gain[c].ln());
            // Photos 0 to 2 are around 0, as photo 3 is.
            let mean = (logs[0] + logs[2]) / 2.;
            let expected = [logs[0] - mean, logs[1] - mean, logs[2] - mean, 0.];
            let all = expected.iter().sum::<f64>() / 4.;
            for (found, expected) in found.iter().zip(expected) {
                assert!((found[c] - (expected - all)).abs() < 0.01, "{} is not {}", found[c], expected - all);
            }
        }
    }

    /// Initial Gaussians have the average exposure, whichever photo they come from.
    #[test]
    fn initial_colors_have_the_average_exposure() {
        let gains = [0.8, 1.25, 1.];
        let views: Vec<View> = [-0.5, 0., 0.5].into_iter().zip(gains).map(|(x, g)| wall(x, [g; 3])).collect();
        let initial = |correction| {
            gaussians_from_photos(&views, &[], 900, SWEEP_SIDE, 0, correction, |_| true).expect("depths")
        };
        // Brightness of the Gaussians of each photo, relative to all: a third of them come from each.
        let brightness = |scene: &PhotoInit| {
            let colors = &scene.gaussians.sh * SH_C0 + 0.5;
            let of = |photo: i64| colors.narrow(1, 300 * photo, 300).mean(Kind::Double).double_value(&[]);
            [0, 1, 2].map(|photo| of(photo) / colors.mean(Kind::Double).double_value(&[]))
        };
        let (corrected, uncorrected) = (initial(ExposureCorrection::On), initial(ExposureCorrection::Off));
        assert!(uncorrected.log_exposures.is_none() && brightness(&uncorrected)[1] > 1.15);
        for (photo, found) in brightness(&corrected).into_iter().enumerate() {
            assert!((found - 1.).abs() < 0.04, "photo {photo}: {found}");
            let exposure = corrected.log_exposures.as_ref().unwrap()[photo][0].exp();
            assert!((exposure / gains[photo] - 1.).abs() < 0.02, "photo {photo}: {exposure}");
        }
    }

    /// Exposures are corrected if neighbors differ, and neither if they change gradually nor if the differences are invisible.
    #[test]
    fn uneven_exposures_are_recognized() {
        let cameras: Vec<Camera> = (0..9).map(|x| wall(f64::from(x), [1.; 3]).camera).collect();
        let is_uneven = |of: fn(usize) -> f64| {
            let gains: Vec<LogGains> = (0..9).map(|index| [of(index); 3]).collect();
            are_uneven(&gains, &cameras)
        };
        assert!(is_uneven(|index| [0.1, -0.2, 0.1][index % 3]));
        assert!(!is_uneven(|index| [0.01, -0.02, 0.01][index % 3]));
        assert!(!is_uneven(|index| 0.1 * (index as f64 - 4.)));
        // Two and three photos, and photos that are each there twice.
        assert!(are_uneven(&[[0.5; 3], [-0.5; 3]], &cameras[..2]));
        assert!(!are_uneven(&[[0.5; 3], [0.; 3], [-0.5; 3]], &cameras[..3]));
        let twice = |index: usize| cameras[index / 2];
        let gains: Vec<LogGains> = (0..18).map(|index| [[0.1, -0.2, 0.1][index / 2 % 3]; 3]).collect();
        assert!(are_uneven(&gains, &(0..18).map(twice).collect::<Vec<Camera>>()));
    }
}
