//! Options of a refinement session.

use super::config::RefineConfig;
use crate::data::{Capture, Holdout, PhotoSize};
use crate::error::{Error, Result};
use crate::reconstruct::spread_over_path;
use crate::scene::{Camera, ImageSize};
use rand::Rng;
use serde::Deserialize;
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

/// Default of [`RefineOptions::seconds`].
const DEFAULT_SECONDS: f64 = 60.;
/// Maximum of [`RefineOptions::seconds`]: a year.
const MAX_SECONDS: f64 = 365. * 24. * 3600.;
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

/// Options of a session, which the program reads from its command line and the Python package from its arguments.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[cfg_attr(feature = "cli", derive(clap::Args))]
pub struct RefineOptions {
    /// Number of Gaussians, not allowed with --splat. auto: 16384 to 1000000, by --seconds, the number of cores and the photos; 16384
    /// with --steps
    #[cfg_attr(feature = "cli", arg(long, value_name = "N|auto", default_value = "auto", value_parser = parse_gaussians))]
    // A plain `Option` would be an option that may be missing.
    pub gaussians: std::option::Option<usize>,
    /// Total time in seconds, from the start of the program to its end
    #[cfg_attr(feature = "cli", arg(long, value_name = "S", default_value_t = DEFAULT_SECONDS, conflicts_with = "steps"))]
    pub seconds: f64,
    /// Number of steps, instead of a time: the same steps and seed give the same bytes
    #[cfg_attr(feature = "cli", arg(long, value_name = "N"))]
    pub steps: Option<u64>,
    /// Seed of the random numbers
    #[cfg_attr(feature = "cli", arg(long, value_name = "S", default_value_t = 0))]
    pub seed: u64,
    /// Views to hold out and score: every:N, every:N+K, or none for only the capture's own test split
    #[cfg_attr(feature = "cli", arg(long, value_name = "WHICH", default_value = "none"))]
    pub holdout: Holdout,
    /// Maximum number of the other views, spread along the camera path; by default as many as fit into about 2 GB of memory
    #[cfg_attr(feature = "cli", arg(long, value_name = "N"))]
    pub views: Option<usize>,
    /// Size of the photos: the longer side to which larger ones are downscaled, as in 1600, or WxH, to which all are cropped and
    /// resized; by default 512, with more than 25,000 Gaussians 1024, and with more than 250,000 1600
    #[cfg_attr(feature = "cli", arg(long, value_name = "N|WxH"))]
    pub size: Option<PhotoSize>,
    /// Also optimize a correction of each camera's pose
    #[cfg_attr(feature = "cli", arg(long))]
    pub correct_poses: bool,
    /// Also optimize a gain of red, green and blue for each photo. auto: if the exposures of neighboring photos differ, which is
    /// measured together with depths, never with --splat; without a value: on
    #[cfg_attr(
        feature = "cli",
        arg(
            long,
            value_name = "WHEN",
            default_value = "auto",
            default_missing_value = "on",
            num_args = 0..=1,
            require_equals = true
        )
    )]
    pub correct_exposures: ExposureCorrection,
    /// Background of masked pixels instead of ignoring them, so that the splat stays empty there
    #[cfg_attr(feature = "cli", arg(long, value_enum, value_name = "COLOR"))]
    pub mask_background: Option<MaskBackground>,
    /// Optimize the splat for antialiased rendering, which looks right at smaller sizes and from afar, too. The file is marked, and
    /// viewers have to support it: others show the splat slightly worse
    #[cfg_attr(feature = "cli", arg(long))]
    pub antialiased: bool,
    /// Override a setting of the method, as in views=4; docs/refine.md lists them
    #[cfg_attr(feature = "cli", arg(long, value_name = "KEY=VALUE"))]
    pub set: Vec<String>,
    /// Start of the time budget; if it is `None`, the start of the session.
    #[serde(skip)]
    #[cfg_attr(feature = "cli", arg(skip))]
    pub started: Option<Instant>,
    /// Device of the depth estimation and the optimization.
    #[serde(skip)]
    #[cfg_attr(feature = "cli", arg(skip = Device::Cpu))]
    pub device: Device,
}

/// Condition for the correction of exposures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum ExposureCorrection {
    /// Never
    Off,
    /// If the exposures of neighboring photos differ
    // Where the exposure changes gradually from photo to photo, a splat without corrections shows it, too, and is closer to photos in
    // between.
    #[default]
    Auto,
    /// Always
    On,
}

/// Background that a splat is seen over where photos are masked out, so that nothing is left there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum MaskBackground {
    /// Black
    Black,
    /// White
    White,
    /// Another color in every step
    // No Gaussian can imitate it.
    Random,
}

impl MaskBackground {
    /// Returns red, green and blue of the background of a step.
    pub(super) fn color(self, random: &mut impl Rng) -> [f32; 3] {
        match self {
            MaskBackground::Black => [0.; 3],
            MaskBackground::White => [1.; 3],
            MaskBackground::Random => random.random(),
        }
    }
}

/// Parses a number of Gaussians; `None` stands for `auto`.
#[cfg(feature = "cli")]
fn parse_gaussians(text: &str) -> std::result::Result<Option<usize>, String> {
    const MAX: usize = 10_000_000;
    match text.parse() {
        _ if text == "auto" => Ok(None),
        Ok(count) if (1..=MAX).contains(&count) => Ok(Some(count)),
        _ => Err(format!("expected 1 to {MAX}, or auto")),
    }
}

impl Default for RefineOptions {
    /// Returns the options for one minute on the CPU.
    fn default() -> Self {
        RefineOptions {
            gaussians: None,
            seconds: DEFAULT_SECONDS,
            steps: None,
            seed: 0,
            holdout: Holdout::None,
            views: None,
            size: None,
            correct_poses: false,
            correct_exposures: ExposureCorrection::Auto,
            mask_background: None,
            antialiased: false,
            set: vec![],
            started: None,
            device: Device::Cpu,
        }
    }
}

impl RefineOptions {
    /// Returns the number of steps, or the time, which includes reading the photos, the start, the scores, and writing the splat.
    pub fn budget(&self) -> Budget {
        let time = || Budget::Time(Duration::from_secs_f64(self.seconds));
        self.steps.map_or_else(time, Budget::Steps)
    }

    /// Returns the hyperparameters. `from_splat` selects the defaults of [`RefineConfig::from_splat`].
    ///
    /// # Errors
    /// Fails like [`RefineConfig::with`].
    pub fn config(&self, from_splat: bool) -> Result<RefineConfig> {
        let mut config = RefineConfig::with(&self.set, from_splat)?;
        config.antialiased |= self.antialiased;
        Ok(config)
    }

    /// Returns a number of Gaussians that suits the time budget, the number of cores, and the photos of `capture`. Without a time budget it
    /// depends on nothing.
    pub fn gaussians_for(&self, capture: &Capture) -> usize {
        let Budget::Time(time) = self.budget() else { return MIN_GAUSSIANS };
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
    ///
    /// # Errors
    /// Fails if one isn't, or like [`RefineOptions::config`].
    pub fn check(&self) -> Result<()> {
        self.config(false)?;
        // NaN is refused, too.
        if !(self.seconds > 0. && self.seconds <= MAX_SECONDS) {
            return Err(Error::setting("seconds", self.seconds, "more than 0, up to a year"));
        }
        if self.gaussians == Some(0) {
            return Err(Error::setting("gaussians", 0, "1 or more"));
        }
        if let Some(views @ ..2) = self.views {
            return Err(Error::setting("views", views, "2 or more"));
        }
        Ok(())
    }

    /// Returns the number of Gaussians to create from photos, from which their number grows to `count`.
    pub(super) fn initial_gaussians(&self, count: usize, config: &RefineConfig) -> usize {
        match self.steps {
            Some(..MIN_STEPS_TO_GROW) => count,
            _ => (count as f64 * config.initial_gaussians).ceil() as usize,
        }
    }

    /// Returns the indices of the photos to match, which have `size`, and of the held-out views, and a warning if large captures have more than fit into memory.
    pub(super) fn select_views(
        &self,
        capture: &Capture,
        size: PhotoSize,
    ) -> ([Vec<usize>; 2], Option<String>) {
        let cameras = capture.cameras();
        let (all_shown, all_held_out) = capture.split(self.holdout);
        let bytes = |camera: &Camera| {
            let ImageSize { height, width } = size.of(camera);
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

/// Minimum time for the optimization, however long the start took.
const MIN_TIME: Duration = Duration::from_secs(1);
/// Maximum fraction of the time for computing depths, beyond the first `FEW_PHOTOS` photos.
const MAX_START_SHARE: f64 = 0.5;
/// Number of photos whose depths are computed regardless of the time budget.
const FEW_PHOTOS: usize = 2;
/// Maximum fraction of the time for scores during the optimization.
const MAX_SCORING_SHARE: f64 = 0.03;
/// Maximum fraction of the time for scoring whole held-out views before the optimization, and again for scoring them after it.
const MAX_WHOLE_SCORING_SHARE: f64 = 0.05;
/// Estimated time for writing the splat and ending the program: a constant, and the time per Gaussian.
const WRITING_TIME: Duration = Duration::from_millis(200);
const WRITING_TIME_PER_GAUSSIAN: Duration = Duration::from_micros(2);

/// Clock of a session that divides its budget.
#[derive(Debug)]
pub(super) struct TimeBudget {
    budget: Budget,
    clock: Instant,
    /// Time for work after the optimization.
    pub reserve: Duration,
    /// Time that scores took during the optimization.
    scoring: Duration,
    /// Time of the last of these scores; before the first, its expected time.
    pub last_scoring: Duration,
}

impl TimeBudget {
    pub fn new(budget: Budget, clock: Instant) -> Self {
        let none = Duration::ZERO;
        TimeBudget { budget, clock, reserve: none, scoring: none, last_scoring: none }
    }

    /// Returns the time since the clock began.
    pub fn elapsed(&self) -> Duration {
        self.clock.elapsed()
    }

    /// Returns the time since the clock began in seconds.
    pub fn seconds(&self) -> f64 {
        self.elapsed().as_secs_f64()
    }

    /// Reserves the time of writing a splat of `count` Gaussians.
    pub fn reserve_for_writing(&mut self, count: i64) {
        self.reserve += WRITING_TIME + WRITING_TIME_PER_GAUSSIAN * count as u32;
    }

    /// Returns `true` if the depths of `done` photos have to be enough.
    pub fn is_late_for_depths(&self, done: usize) -> bool {
        match self.budget {
            Budget::Steps(_) => false,
            Budget::Time(time) => done >= FEW_PHOTOS && self.elapsed() > time.mul_f64(MAX_START_SHARE),
        }
    }

    /// Returns a warning if reading the photos and the start left little or no time for the optimization.
    pub fn late_start_warning(&self) -> Option<String> {
        let Budget::Time(time) = self.budget else { return None };
        let elapsed = self.elapsed();
        (elapsed + self.reserve + MIN_TIME.min(time) > time).then(|| {
            let (time, elapsed) = (time.as_secs_f64(), elapsed.as_secs_f64());
            format!("{time:.0} s are too short here: reading the photos and the initialization took {elapsed:.1} s; few steps are left")
        })
    }

    /// Returns the interval between the held-out views that there is time to score as a whole, if all would take `all`.
    pub fn affordable_every(&self, all: Duration) -> usize {
        match self.budget {
            Budget::Steps(_) => 1,
            Budget::Time(time) => {
                all.div_duration_f64(time.mul_f64(MAX_WHOLE_SCORING_SHARE)).ceil().max(1.) as usize
            }
        }
    }

    /// Returns `true` if another scoring keeps the total time of scoring below its maximum fraction of the time since the clock began.
    pub fn may_score(&self) -> bool {
        (self.scoring + self.last_scoring).as_secs_f64() <= MAX_SCORING_SHARE * self.seconds()
    }

    /// Adds the time of a scoring during the optimization.
    pub fn add_scoring(&mut self, time: Duration) {
        self.last_scoring = time;
        self.scoring += time;
    }

    /// Returns the budget of an optimization that continues one of `optimized`, for which `earlier` was spent in all.
    pub fn remaining(&self, optimized: Duration, earlier: Duration) -> Budget {
        match self.budget {
            Budget::Time(time) => {
                let used = self.reserve + self.elapsed() + earlier;
                Budget::Time(optimized + time.saturating_sub(used).max(MIN_TIME.min(time)))
            }
            steps => steps,
        }
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
        let options = RefineOptions { holdout: Holdout::Every { every: 8, first: 0 }, ..Default::default() };
        let ([shown, held_out], warning) = options.select_views(&capture, PhotoSize::Within(1024));
        // 1024×768 pixels of 4 bytes each.
        let each = 4 * 1024 * 768;
        assert_eq!((shown.len(), held_out.len()), ((1280 << 20) / each, (256 << 20) / each));
        let line = warning.unwrap();
        assert!(line.starts_with("walk: 426 of 1750 photos are matched and 85 of 250 scored"), "{line}");
        let small = PhotoSize::Exactly([96, 128].into());
        let ([shown, held_out], warning) = options.select_views(&capture, small);
        assert_eq!((shown.len(), held_out.len(), warning), (1750, 250, None));
        let all = RefineOptions { views: Some(500), holdout: Holdout::None, ..options };
        let ([shown, held_out], warning) = all.select_views(&capture, PhotoSize::Within(1024));
        assert_eq!((shown.len(), held_out.len(), warning), (500, 0, None));
    }

    #[test]
    fn the_number_of_gaussians_grows_if_there_is_time() {
        let initial = |steps, count| {
            RefineOptions { steps, ..Default::default() }.initial_gaussians(count, &RefineConfig::default())
        };
        assert_eq!(initial(None, 16_384), 3277);
        assert_eq!(initial(Some(500), 101), 21);
        assert_eq!(initial(Some(499), 101), 101);
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
        let after = |seconds: f64, capture: &Capture| {
            RefineOptions { seconds, ..RefineOptions::default() }.gaussians_for(capture)
        };
        let (large, small) = (capture(1000, 50), capture(256, 9));
        let minute = after(60., &large);
        assert!((16_384..=1_000_000).contains(&minute));
        assert!(after(120., &large) == (2 * minute).min(1_000_000) || minute == 16_384, "{minute}");
        assert_eq!(after(1., &large), 16_384);
        // After four minutes more time is for more steps.
        let most = after(240., &large);
        assert!(most == (4 * minute).min(1_000_000) || minute == 16_384, "{minute} {most}");
        assert_eq!(after(100_000., &large), most);
        // A Gaussian for 24 pixels.
        assert_eq!(after(100_000., &small), 256 * 256 * 9 / 24);
        let steps = RefineOptions { steps: Some(100_000), ..RefineOptions::default() };
        assert_eq!(steps.gaussians_for(&large), 16_384);
    }

    #[test]
    fn options_out_of_range_are_refused() {
        let default = RefineOptions::default;
        assert!(default().check().is_ok());
        for (options, expected) in [
            (RefineOptions { set: vec!["views=0".into()], ..default() }, "views=0: expected 1 or more"),
            (RefineOptions { seconds: 0., ..default() }, "seconds is 0, expected more than 0"),
            (RefineOptions { seconds: f64::NAN, ..default() }, "seconds is NaN, expected more than 0"),
            (RefineOptions { gaussians: Some(0), ..default() }, "gaussians is 0, expected 1 or more"),
            (RefineOptions { views: Some(1), ..default() }, "views is 1, expected 2 or more"),
        ] {
            let error = options.check().unwrap_err();
            assert!(error.is_invalid_request() && error.to_string().contains(expected), "{error}");
        }
    }
}
