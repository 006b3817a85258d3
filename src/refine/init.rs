//! Initial Gaussians from photos, from photos and points, or from known Gaussians that agree with the photos.

use super::exposures::{LogGains, correct_exposures};
use super::options::{ExposureCorrection, RefineOptions};
use super::state::RefineState;
use crate::data::{Capture, PhotoSize, Point, View};
use crate::error::Result;
use crate::io::Splat;
use crate::quality::CaptureQuality;
use crate::reconstruct::LoadedModel;
use crate::render::{contributions, largest_contributions};
use crate::scene::{Camera, RawGaussians, SH_C0};
use crate::stereo::{DepthMap, PlaneSweepOutput, pixel_and_depth, sweep};
use glam::DVec3;
use rand::seq::index::sample;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::{Device, Kind, Tensor};

/// Standard deviation of a Gaussian, in units of the distance between neighboring Gaussians.
const EXTENT: f64 = 0.5;
/// Initial logit of the opacity.
const LOGIT: f32 = -1.;
/// Divisor of the minimum number of Gaussians at depths instead of points: 1/`DEPTHS_SHARE` of all. Points are exact, but there are none on
/// plain surfaces.
const DEPTHS_SHARE: usize = 10;
/// Maximum relative distance of a Gaussian from the depth that the photos agree on.
const NEAR: f64 = 0.1;

/// Isotropic Gaussian.
struct IsotropicGaussian {
    mean: DVec3,
    scale: f64,
    color: [f32; 3],
}

/// Source of the initial Gaussians.
#[derive(Debug, Clone, Copy)]
pub enum SceneInit<'a> {
    /// Pixels of the photos, at depths on which the photos agree.
    Photos,
    /// Splat in the capture's world.
    Splat(&'a Splat),
    /// Reconstruction of the photos by a model. It sees [`RefineOptions::max_views`] of them, or the number in its configuration.
    Model(&'a LoadedModel),
    /// State of an earlier refinement of the same capture, which continues. The time and the steps of [`RefineOptions`] include those of
    /// the earlier refinement.
    State(&'a RefineState),
}

impl SceneInit<'_> {
    /// Returns `true` if the Gaussians are those of a splat, whose number stays.
    pub(super) fn is_splat(&self) -> bool {
        match self {
            SceneInit::Splat(_) => true,
            SceneInit::State(state) => state.record.from_splat,
            SceneInit::Photos | SceneInit::Model(_) => false,
        }
    }

    /// Returns the final number of Gaussians and the size of the photos.
    pub(super) fn sizes(&self, capture: &Capture, options: &RefineOptions) -> (usize, PhotoSize) {
        let gaussians = match self {
            SceneInit::Splat(splat) => splat.len().max(1),
            SceneInit::State(state) if state.record.from_splat => state.count(),
            _ => options.gaussians.unwrap_or_else(|| options.gaussians_for(capture)),
        };
        (gaussians, options.size_for(gaussians))
    }
}

/// Initial state of a scene from photos alone.
#[derive(Debug)]
pub struct PhotoInit {
    /// Initial Gaussians, on the CPU.
    pub gaussians: RawGaussians,
    /// Depths of some photos.
    pub depth_maps: Vec<DepthMap>,
    /// Logarithms of the gains of red, green and blue of each photo, if exposures are to be corrected. Their mean is 0.
    pub log_exposures: Option<Vec<[f64; 3]>>,
    /// Quality of the capture; `None` if the work was ended before all depths were known.
    pub quality: Option<CaptureQuality>,
}

/// Creates `count` Gaussians at the depths on which the photos agree, and at `points` of the scene, if some are known. The photos are compared
/// at `side` pixels along their longer side. The size of each Gaussian matches the part of the images that it covers. At least two views are
/// required. `should_continue` is called before each photo with the number of photos that are done. If it returns `false`, Gaussians are
/// created from the photos that are done, or `None` is returned if there are none.
pub fn gaussians_from_photos(
    views: &[View],
    points: &[Point],
    count: usize,
    side: f64,
    seed: u64,
    exposures: ExposureCorrection,
    should_continue: impl FnMut(usize) -> bool,
) -> Option<PhotoInit> {
    let photos = views.iter().map(|view| view.to_small_photo(side)).collect();
    let swept = sweep(photos, points, should_continue);
    if swept.depth_maps.is_empty() {
        return None;
    }
    let quality = swept.is_complete.then(|| CaptureQuality::of_views(views, &swept));
    let PlaneSweepOutput { photos, mut depth_maps, .. } = swept;
    let log_exposures: Option<Vec<LogGains>> = correct_exposures(exposures, &photos, &depth_maps);
    if let Some(gains) = &log_exposures {
        for (index, map) in &mut depth_maps {
            let gains = Tensor::from_slice(&gains[*index].map(f64::exp)).to_kind(Kind::Float);
            map.image = &map.image / gains.view([3, 1, 1]);
        }
    }
    let depth_maps: Vec<DepthMap> = depth_maps.into_iter().map(|(_, map)| map).collect();
    let gaussians = sample_gaussians(&depth_maps, points, count, seed);
    Some(PhotoInit { gaussians, depth_maps, log_exposures, quality })
}

/// Returns at most `count` of the `known` Gaussians, on the CPU: of those that don't contradict the photos of `depth_maps`, the ones that
/// contribute the most to them.
///
/// # Errors
/// Fails if rendering fails.
pub(super) fn most_visible(
    known: &RawGaussians,
    depth_maps: &[DepthMap],
    count: usize,
) -> Result<RawGaussians> {
    let supported = known.select(&supported(known, depth_maps)).to_device(Device::Cpu);
    let cameras: Vec<Camera> = depth_maps.iter().map(|map| map.camera).collect();
    let contributions = contributions(&supported.activate(), &cameras)?;
    let kept = largest_contributions(&contributions, count).into_iter().map(|index| index as i64);
    Ok(supported.select(&kept.collect::<Vec<_>>()))
}

/// Returns the indices of the Gaussians that the photos support. A Gaussian must not be in front of a depth that a photo is sure of, and at
/// least one photo must see it unoccluded or not be sure of the depth there.
fn supported(raw: &RawGaussians, depth_maps: &[DepthMap]) -> Vec<i64> {
    let means =
        Vec::<f64>::try_from(raw.means.to_kind(Kind::Double).contiguous().view([-1])).expect("numbers");
    let map =
        |of: &DepthMap| (pixel_and_depth(&of.camera), of.depths(), of.sure_pixels(), of.counted_pixels());
    let maps: Vec<_> = depth_maps.iter().map(map).collect();
    let holds = |mean: DVec3| {
        let mut shown = false;
        for (seen, depth, sure, counted) in &maps {
            let Some((pixel, z)) = seen(mean) else { continue };
            if counted.as_ref().is_some_and(|counted| !counted[pixel]) {
                continue;
            }
            let nearness = z / f64::from(depth[pixel]);
            if sure[pixel] && nearness < 1. - NEAR {
                return false;
            }
            shown |= !sure[pixel] || nearness < 1. + NEAR;
        }
        shown
    };
    (0..means.len() / 3).filter(|&i| holds(DVec3::from_slice(&means[3 * i..]))).map(|i| i as i64).collect()
}

/// Returns `points` without those that photos show only where they are masked out.
fn points_that_count<'a>(points: &'a [Point], depth_maps: &[DepthMap]) -> Vec<&'a Point> {
    let map = |of: &DepthMap| (pixel_and_depth(&of.camera), of.counted_pixels());
    let maps: Vec<_> = depth_maps.iter().map(map).collect();
    let counts = |point: &&Point| {
        let mut places = maps.iter().filter_map(|(seen, counted)| {
            let (pixel, _) = seen(point.position)?;
            Some(counted.as_ref().is_none_or(|counted| counted[pixel]))
        });
        places.next().is_none_or(|first| first || places.any(|counts| counts))
    };
    points.iter().filter(counts).collect()
}

fn sample_gaussians(depth_maps: &[DepthMap], points: &[Point], count: usize, seed: u64) -> RawGaussians {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let points = points_that_count(points, depth_maps);
    // Cumulative numbers of pixels that count, and of depth maps' worth of them.
    let (mut pixels, mut shares) = (0., vec![0.]);
    for of in depth_maps {
        let all = f64::from(of.camera.width * of.camera.height);
        let counted = of.counted.as_ref().map_or(all, |counted| counted.sum(Kind::Int64).double_value(&[]));
        pixels += counted;
        shares.push(shares[shares.len() - 1] + counted / all);
    }
    let spacing = (pixels / count.max(1) as f64).sqrt(); // in pixels of the downscaled images
    let chosen = sample(&mut random, points.len(), points.len().min(count - count / DEPTHS_SHARE));
    let mut gaussians: Vec<IsotropicGaussian> =
        chosen.iter().map(|i| at_point(points[i], depth_maps, spacing)).collect();
    let left = count - gaussians.len();
    for (index, of) in depth_maps.iter().enumerate() {
        // Cumulative shares, so that the counts add up to `left`.
        let share = |i: usize| match i == depth_maps.len() {
            true => left,
            false => (left as f64 * shares[i] / shares[depth_maps.len()]) as usize,
        };
        sample_pixels(of, share(index + 1) - share(index), spacing, &mut random, &mut gaussians);
    }
    raw(&gaussians)
}

/// Creates a Gaussian at a point, with the size that it would have if the nearest camera had seen it.
fn at_point(point: &Point, depth_maps: &[DepthMap], spacing: f64) -> IsotropicGaussian {
    let size =
        |of: &DepthMap| point.position.distance(of.camera.c2w.w_axis.truncate()) / of.camera.intrinsics.fx;
    let least = depth_maps.iter().map(size).fold(f64::INFINITY, f64::min);
    IsotropicGaussian { mean: point.position, scale: EXTENT * spacing * least, color: point.color }
}

/// Appends `count` Gaussians at random pixels of `of` that count to `gaussians`.
fn sample_pixels(
    of: &DepthMap,
    count: usize,
    spacing: f64,
    random: &mut impl Rng,
    gaussians: &mut Vec<IsotropicGaussian>,
) {
    let (width, height) = (of.camera.width as usize, of.camera.height as usize);
    let (depth, image) = (of.depths(), of.colors());
    let counted =
        of.counted_pixels().map(|counted| (0..counted.len()).filter(|&i| counted[i]).collect::<Vec<_>>());
    for _ in 0..count {
        let (u, v) = match &counted {
            Some(counted) => {
                let pixel = counted[random.random_range(0..counted.len())];
                let (x, y) = ((pixel % width) as f64, (pixel / width) as f64);
                (x + random.random::<f64>(), y + random.random::<f64>())
            }
            None => (random.random_range(0. ..width as f64), random.random_range(0. ..height as f64)),
        };
        let pixel = v as usize * width + u as usize;
        let z = f64::from(depth[pixel]);
        gaussians.push(IsotropicGaussian {
            mean: of.camera.unproject(u, v, z),
            scale: EXTENT * spacing * z / of.camera.intrinsics.fx,
            color: [0, 1, 2].map(|channel| image[channel * width * height + pixel]),
        });
    }
}

fn raw(gaussians: &[IsotropicGaussian]) -> RawGaussians {
    let n = gaussians.len() as i64;
    let of = |values: Vec<f64>, shape: &[i64]| Tensor::from_slice(&values).to_kind(Kind::Float).view(shape);
    let colors = gaussians.iter().flat_map(|g| g.color.map(|c| (f64::from(c) - 0.5) / SH_C0));
    RawGaussians {
        means: of(gaussians.iter().flat_map(|g| g.mean.to_array()).collect(), &[1, n, 3]),
        log_scales: of(gaussians.iter().flat_map(|g| [g.scale.ln(); 3]).collect(), &[1, n, 3]),
        quaternions: of(gaussians.iter().flat_map(|_| [1., 0., 0., 0.]).collect(), &[1, n, 4]),
        opacity_logits: Tensor::full([1, n], f64::from(LOGIT), (Kind::Float, Device::Cpu)),
        sh: of(colors.collect(), &[1, n, 1, 3]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Camera;
    use glam::DMat4;

    /// Gaussians that contradict the photos are removed. Two cameras are sure of a wall at depth 4, the second only in the left half of its
    /// image.
    #[test]
    fn gaussians_that_contradict_photos_are_removed() {
        let options = (Kind::Float, Device::Cpu);
        let wall = |x: f64, sure_columns: i64| DepthMap {
            camera: Camera {
                c2w: DMat4::from_translation(DVec3::new(x, 0., 0.)),
                ..DepthMap::flat(16, 16, 4.).camera
            },
            sure: Tensor::arange(16, options).lt(sure_columns as f64).expand([16, 16], false).contiguous(),
            ..DepthMap::flat(16, 16, 4.)
        };
        let depth_maps = [wall(0., 16), wall(0.5, 8)];
        let kept = |means: &[[f64; 3]]| {
            let n = means.len() as i64;
            let of = |shape: &[i64]| Tensor::zeros(shape, options);
            let raw = RawGaussians {
                means: Tensor::from_slice(means.as_flattened()).to_kind(Kind::Float).view([1, n, 3]),
                log_scales: of(&[1, n, 3]),
                quaternions: of(&[1, n, 4]),
                opacity_logits: of(&[1, n]),
                sh: of(&[1, n, 1, 3]),
            };
            supported(&raw, &depth_maps)
        };
        // The Gaussians are on the wall, in front of it, behind it, and outside both images.
        assert_eq!(kept(&[[0., 0., 4.1], [0., 0., 2.], [0., 0., 9.], [30., 0., 4.]]), [0]);
        // The first is behind the wall in one image, but the other camera isn't sure there, so it stays.
        assert_eq!(kept(&[[3., 0., 9.], [3., 0., 2.]]), [0]);
    }

    /// No Gaussian starts at a masked pixel, and points that photos show only there are left out.
    #[test]
    fn masked_pixels_start_no_gaussians() {
        let options = (Kind::Float, Device::Cpu);
        let map = |counted: Option<Tensor>| DepthMap { counted, ..DepthMap::flat(16, 16, 4.) };
        let right = Tensor::arange(16, options).ge(8.).expand([16, 16], false).contiguous();
        let point = |x: f64| Point { position: DVec3::new(x, 0., 4.), color: [0.5; 3] };
        let points = [point(-1.), point(1.), point(-9.)];
        let xs = |maps: &[DepthMap]| -> Vec<f64> {
            let raw = sample_gaussians(maps, &points, 200, 0);
            Vec::try_from(raw.means.select(2, 0).view([-1]).to_kind(Kind::Double)).expect("numbers")
        };
        let masked = xs(&[map(Some(right.shallow_clone()))]);
        assert_eq!(masked.len(), 200);
        // The point that no photo shows stays.
        assert_eq!(masked.iter().filter(|x| **x < 0.).copied().collect::<Vec<_>>(), [-9.]);
        // Another photo shows the first point, and gets two thirds of the Gaussians.
        let both = xs(&[map(Some(right)), map(None)]);
        assert!(both.contains(&-1.));
        let left = both.iter().filter(|x| **x < 0.).count();
        assert!((50..85).contains(&left), "{left}");
    }

    /// The known Gaussians that don't contradict the photos and contribute the most are kept, up to the requested number.
    #[test]
    fn the_most_visible_gaussians_are_kept() {
        let options = (Kind::Float, Device::Cpu);
        let wall = DepthMap {
            sure: Tensor::ones([16, 16], (Kind::Bool, Device::Cpu)),
            ..DepthMap::flat(16, 16, 4.)
        };
        // The first is in front of the wall, which a photo is sure of; the others are on it, and the last one is the largest.
        let means = [[0f32, 0., 2.], [-0.5, 0., 4.], [0.5, 0., 4.]];
        let known = RawGaussians {
            means: Tensor::from_slice(means.as_flattened()).view([1, 3, 3]),
            log_scales: Tensor::from_slice(&[-1f32, -2., -1.]).view([1, 3, 1]).repeat([1, 1, 3]),
            quaternions: Tensor::from_slice(&[1f32, 0., 0., 0.]).repeat([1, 3, 1]),
            opacity_logits: Tensor::zeros([1, 3], options),
            sh: Tensor::zeros([1, 3, 1, 3], options),
        };
        for (count, expected) in [(0, &[][..]), (1, &[2]), (2, &[2, 1]), (9, &[2, 1])] {
            let kept = most_visible(&known, std::slice::from_ref(&wall), count).unwrap();
            assert!(kept.means.equal(&known.select(expected).means), "{count}");
        }
        let hidden = known.select(&[0]);
        assert_eq!(most_visible(&hidden, &[wall], 5).unwrap().means.size(), [1, 0, 3]);
    }
}
