//! Options of a refinement session.

use super::config::RefineConfig;
use super::exposures::ExposureCorrection;
use crate::data::{Capture, Holdout, PhotoSize};
use crate::error::{Error, Result};
use crate::reconstruct::spread_over_path;
use crate::scene::{Camera, ImageSize};
use rand::Rng;
use std::time::{Duration, Instant};
use tch::Device;

/// Budget of an optimization.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Budget {
    /// Number of steps. The same number of steps gives bit-identical results.
    Steps(u64),
    /// Wall-clock time, including all other work.
    Time(Duration),
}

/// Background that a splat is seen over where photos are masked out, so that nothing is left there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MaskBackground {
    /// Black.
    Black,
    /// White.
    White,
    /// Another colour in every step, which no Gaussian can imitate.
    Random,
}

impl Budget {
    /// Maximum time in seconds: a year.
    const MAX_SECONDS: f64 = 365. * 24. * 3600.;

    /// Returns a time of that many seconds; `None` unless it is more than 0, up to a year.
    pub fn from_seconds(seconds: f64) -> Option<Self> {
        let is_valid = seconds > 0. && seconds <= Self::MAX_SECONDS;
        is_valid.then(|| Budget::Time(Duration::from_secs_f64(seconds)))
    }
}

impl MaskBackground {
    /// Returns red, green and blue of the background of a step.
    pub(super) fn colour(self, random: &mut impl Rng) -> [f32; 3] {
        match self {
            MaskBackground::Black => [0.; 3],
            MaskBackground::White => [1.; 3],
            MaskBackground::Random => random.random(),
        }
    }
}

/// Number of Gaussians that one core can optimize in one second of a time budget.
const GAUSSIANS_PER_CORE_SECOND: f64 = 400.;
/// Time in seconds after which more time is for more steps, not for more Gaussians, which match the photos better but not other views.
const MAX_SECONDS_OF_GROWTH: f64 = 240.;
/// Minimum number of pixels, in all photos together, for each Gaussian.
const PIXELS_PER_GAUSSIAN: u64 = 24;
/// Number of Gaussians of the paper's main model, the minimum of [`RefineOptions::gaussians_for`].
pub(super) const MIN_GAUSSIANS: usize = 16_384;
/// Maximum of [`RefineOptions::gaussians_for`].
const MAX_GAUSSIANS: usize = 1_000_000;
/// Default of the longer side of photos in pixels, for the default number of Gaussians.
const LONGEST_SIDE: u32 = 512;
/// Longer side of photos in pixels for a large number of Gaussians.
const LARGEST_SIDE: u32 = 1600;
/// Maximum memory of the photos to match, unless their number is given. Smaller copies of them take a third as much again.
const MAX_PHOTO_BYTES: u64 = 1280 << 20;
/// Maximum memory of the held-out views.
const MAX_HELD_OUT_BYTES: u64 = 256 << 20;
/// Memory per pixel of a photo: three channels and a mask, a byte each.
const BYTES_PER_PIXEL: u64 = 4;

/// Minimum number of steps in which the number of Gaussians grows: with fewer, all are there from the start.
const MIN_STEPS_TO_GROW: u64 = 500;

/// Options of a session.
#[derive(Debug, Clone)]
pub struct RefineOptions {
    /// Hyperparameters. [`RefineConfig::from_splat`] returns those for a start from a splat.
    pub config: RefineConfig,
    /// Number of steps, or time. A time includes reading the photos, the start, the scores, and writing the splat.
    pub budget: Budget,
    /// Start of a time budget; if it is `None`, the start of the session.
    pub started: Option<Instant>,
    /// Final number of Gaussians if the initial splat doesn't determine it. A session that is ended early may have fewer.
    pub gaussians: usize,
    /// Seed of the random numbers.
    pub seed: u64,
    /// Views that are held out and scored, see [`Capture::split`].
    pub holdout: Holdout,
    /// Maximum number of the other views, spread along the camera path; if it is `None`, as many as fit into about 2 GB of memory.
    pub views: Option<usize>,
    /// Learns corrections of the camera poses if `true`.
    pub correct_poses: bool,
    /// Condition for learning a gain of red, green and blue of each photo. It begins with exposures that are measured together with depths;
    /// without depths, as with [`super::Initial::Splat`], [`ExposureCorrection::Auto`] corrects nothing.
    pub correct_exposures: ExposureCorrection,
    /// Background that masked pixels have in the optimization. If it is `None`, the optimization ignores masked pixels.
    pub mask_background: Option<MaskBackground>,
    /// Size of the photos.
    pub size: PhotoSize,
    /// Device of the depth estimation and the optimization.
    pub device: Device,
}

impl Default for RefineOptions {
    /// Returns the options for one minute on the CPU, with as many Gaussians as the paper's main model has.
    fn default() -> Self {
        RefineOptions {
            config: RefineConfig::default(),
            budget: Budget::Time(Duration::from_secs(60)),
            started: None,
            gaussians: MIN_GAUSSIANS,
            seed: 0,
            holdout: Holdout::None,
            views: None,
            correct_poses: false,
            correct_exposures: ExposureCorrection::Auto,
            mask_background: None,
            size: PhotoSize::Within(LONGEST_SIDE),
            device: Device::Cpu,
        }
    }
}

impl RefineOptions {
    /// Returns a number of Gaussians that suits the time budget, the number of cores, and the photos of `capture`. Without a time budget it
    /// depends on nothing.
    pub fn gaussians_for(&self, capture: &Capture) -> usize {
        let Budget::Time(time) = self.budget else { return MIN_GAUSSIANS };
        let cores = std::thread::available_parallelism().map_or(1., |cores| cores.get() as f64);
        let by_time = GAUSSIANS_PER_CORE_SECOND * cores * time.as_secs_f64().min(MAX_SECONDS_OF_GROWTH);
        let (cameras, (shown, _)) = (capture.cameras(), capture.split(self.holdout));
        let pixels = |&index: &usize| {
            let ImageSize { height, width } = PhotoSize::Within(LARGEST_SIDE).of(&cameras[index]);
            u64::from(height) * u64::from(width)
        };
        let by_pixels = shown.iter().map(pixels).sum::<u64>() / PIXELS_PER_GAUSSIAN;
        (by_time.min(by_pixels as f64) as usize).clamp(MIN_GAUSSIANS, MAX_GAUSSIANS)
    }

    /// Returns the size of the photos for a number of Gaussians: fewer can't show more detail, and more pixels take more time.
    pub fn size_for(gaussians: usize) -> PhotoSize {
        PhotoSize::Within(match gaussians {
            ..=25_000 => LONGEST_SIDE,
            25_001..=250_000 => 1024,
            _ => LARGEST_SIDE,
        })
    }

    /// Checks that every option is in its range.
    pub(super) fn check(&self) -> Result<()> {
        self.config.check().map_err(|expected| {
            Error::request(format!("a setting of the refinement is out of range, expected {expected}"))
        })?;
        if self.budget == Budget::Time(Duration::ZERO) {
            return Err(Error::setting("the time of the refinement", "0 s", "more than 0 s"));
        }
        if self.gaussians == 0 {
            return Err(Error::setting("the number of Gaussians", 0, "1 or more"));
        }
        if let Some(views @ ..2) = self.views {
            return Err(Error::setting("the number of views", views, "2 or more"));
        }
        Ok(())
    }

    /// Returns the number of Gaussians to create from photos, from which their number grows to [`RefineOptions::gaussians`].
    pub(super) fn initial_gaussians(&self) -> usize {
        match self.budget {
            Budget::Steps(..MIN_STEPS_TO_GROW) => self.gaussians,
            _ => (self.gaussians as f64 * self.config.initial_gaussians).ceil() as usize,
        }
    }

    /// Returns the indices of the photos to match and of the held-out views, and a warning if large captures have more than fit into memory.
    pub(super) fn select_views(&self, capture: &Capture) -> ([Vec<usize>; 2], Option<String>) {
        let cameras = capture.cameras();
        let (all_shown, all_held_out) = capture.split(self.holdout);
        let bytes = |camera: &Camera| {
            let ImageSize { height, width } = self.size.of(camera);
            BYTES_PER_PIXEL * u64::from(height) * u64::from(width)
        };
        let largest = cameras.iter().map(bytes).max().unwrap_or(1);
        let fitting = |bytes: u64| (bytes / largest).max(2) as usize;
        let shown = spread_over_path(&cameras, &all_shown, self.views.unwrap_or(fitting(MAX_PHOTO_BYTES)));
        let held_out = spread_over_path(&cameras, &all_held_out, fitting(MAX_HELD_OUT_BYTES));
        let is_limited =
            (self.views.is_none() && shown.len() < all_shown.len()) || held_out.len() < all_held_out.len();
        let warning = is_limited.then(|| {
            format!(
                "{}: {} of {} photos are matched and {} of {} scored, spread along the camera path, as more need more than about 2 GB of memory",
                capture.name,
                shown.len(),
                all_shown.len(),
                held_out.len(),
                all_held_out.len()
            )
        });
        ([shown, held_out], warning)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;
    use glam::{DMat4, DVec3};
    use globalsplat_capture::ImageSource;
    use image::RgbImage;
    use std::sync::Arc;

    #[derive(Debug)]
    struct NoImages;

    impl ImageSource for NoImages {
        fn name(&self) -> &str {
            "no images"
        }

        fn image(&self, _: usize) -> RgbImage {
            unreachable!("no image is loaded")
        }

        fn depth(&self, _: usize) -> Option<Vec<f32>> {
            None
        }
    }

    #[test]
    fn large_captures_are_limited_to_what_fits_into_memory() {
        let intrinsics = Intrinsics { fx: 1600., fy: 1600., cx: 800., cy: 600. };
        let camera = |index: i32| {
            let c2w = DMat4::from_translation(DVec3::X * f64::from(index));
            Camera { intrinsics, c2w, width: 1600, height: 1200 }
        };
        let cameras: Vec<Camera> = (0..2000).map(camera).collect();
        let capture = Capture::from_source("walk".into(), "".into(), &cameras, Arc::new(NoImages)).unwrap();
        let options = RefineOptions {
            holdout: Holdout::Every { every: 8, first: 0 },
            size: PhotoSize::Within(1024),
            ..Default::default()
        };
        let ([shown, held_out], warning) = options.select_views(&capture);
        // 1024×768 pixels of 4 bytes each.
        let each = 4 * 1024 * 768;
        assert_eq!((shown.len(), held_out.len()), ((1280 << 20) / each, (256 << 20) / each));
        let line = warning.unwrap();
        assert!(line.starts_with("walk: 426 of 1750 photos are matched and 85 of 250 scored"), "{line}");
        let small = RefineOptions { size: PhotoSize::Exactly([96, 128].into()), ..options.clone() };
        let ([shown, held_out], warning) = small.select_views(&capture);
        assert_eq!((shown.len(), held_out.len(), warning), (1750, 250, None));
        let asked = RefineOptions { views: Some(500), holdout: Holdout::None, ..options };
        let ([shown, held_out], warning) = asked.select_views(&capture);
        assert_eq!((shown.len(), held_out.len(), warning), (500, 0, None));
    }

    #[test]
    fn the_number_of_gaussians_grows_if_there_is_time() {
        let of = |budget, gaussians| {
            RefineOptions { budget, gaussians, ..RefineOptions::default() }.initial_gaussians()
        };
        assert_eq!(of(Budget::Time(Duration::from_secs(1)), 16_384), 3277);
        assert_eq!(of(Budget::Steps(500), 101), 21);
        assert_eq!(of(Budget::Steps(499), 101), 101);
    }

    #[test]
    fn the_number_of_gaussians_suits_time_and_photos() {
        let capture = |width: u32, count: i32| {
            let k = f64::from(width);
            let intrinsics = Intrinsics { fx: k, fy: k, cx: k / 2., cy: k / 2. };
            let camera = |index: i32| {
                let c2w = DMat4::from_translation(DVec3::X * f64::from(index));
                Camera { intrinsics, c2w, width, height: width }
            };
            let cameras: Vec<Camera> = (0..count).map(camera).collect();
            Capture::from_source("walk".into(), "".into(), &cameras, Arc::new(NoImages)).unwrap()
        };
        let of = |budget, capture: &Capture| {
            RefineOptions { budget, ..RefineOptions::default() }.gaussians_for(capture)
        };
        let time = |seconds| Budget::Time(Duration::from_secs(seconds));
        let (large, small) = (capture(1000, 50), capture(256, 9));
        let minute = of(time(60), &large);
        assert!((16_384..=1_000_000).contains(&minute));
        assert!(of(time(120), &large) == (2 * minute).min(1_000_000) || minute == 16_384, "{minute}");
        assert_eq!(of(time(1), &large), 16_384);
        // After four minutes more time is for more steps.
        let most = of(time(240), &large);
        assert!(most == (4 * minute).min(1_000_000) || minute == 16_384, "{minute} {most}");
        assert_eq!(of(time(100_000), &large), most);
        // A Gaussian for 24 pixels.
        assert_eq!(of(time(100_000), &small), 256 * 256 * 9 / 24);
        assert_eq!(of(Budget::Steps(100_000), &large), 16_384);
    }

    #[test]
    fn options_out_of_range_are_refused() {
        let default = RefineOptions::default;
        assert!(default().check().is_ok());
        let config = RefineConfig { views: 0, ..RefineConfig::default() };
        for (options, expected) in [
            (RefineOptions { config, ..default() }, "expected 1 or more"),
            (RefineOptions { budget: Budget::Time(Duration::ZERO), ..default() }, "expected more than 0 s"),
            (RefineOptions { gaussians: 0, ..default() }, "number of Gaussians is 0"),
            (RefineOptions { views: Some(1), ..default() }, "number of views is 1"),
        ] {
            let error = options.check().unwrap_err();
            assert!(error.is_invalid_request() && error.to_string().contains(expected), "{error}");
        }
    }
}
