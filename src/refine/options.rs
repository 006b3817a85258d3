//! Options of a refinement. docs/experiments.md has the measurements by which the defaults of the settings
//! were chosen.

use crate::data::{Capture, Holdout, PhotoSize};
use crate::error::{Error, Result};
use crate::reconstruct::spread_over_path;
use crate::scene::{Camera, ImageSize};
use crate::stereo::SWEEP_SIDE;
use rand::Rng;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;
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
/// Number of Gaussians of the paper's main model, the minimum of the default.
pub(super) const MIN_GAUSSIANS: usize = 16_384;
/// Maximum of the default number of Gaussians.
const MAX_GAUSSIANS: usize = 1_000_000;
/// Maximum default of the longer side of photos in pixels.
const LARGEST_SIDE: u32 = 1600;
/// Maximum memory of the photos to match, unless their number is given. Smaller copies of them take a third as much again.
const MAX_PHOTO_BYTES: u64 = 1280 << 20;
/// Maximum memory of the held-out views.
const MAX_HELD_OUT_BYTES: u64 = 256 << 20;
/// Memory per pixel of a photo: three channels and a mask, a byte each.
const BYTES_PER_PIXEL: u64 = 4;
/// Minimum number of steps in which the number of Gaussians grows: with fewer, all are there from the start.
const MIN_STEPS_TO_GROW: u64 = 500;
/// Minimum number of steps, or time, for which photos are compared at twice [`SWEEP_SIDE`].
const MIN_STEPS_OF_LARGE_SWEEP: u64 = 1000;
const MIN_TIME_OF_LARGE_SWEEP: Duration = Duration::from_secs(30);
/// Longer side of photos, in pixels, from which the learning rate of poses falls.
const POSES_SIDE: f64 = 256.;
/// Number of Gaussians above which spherical harmonics have degree 2 by default.
const MANY_GAUSSIANS: i64 = 100_000;
/// Maximum number of photo sizes besides the full size.
const MAX_SIZES: usize = 8;

/// Declares a struct whose fields have their defaults beside them. The command line and JSON have a field for each of `options` and `both`;
/// `--set key=value` changes `both` and `settings`, which are also what serde writes.
macro_rules! options_struct {
    (
        $(#[$meta:meta])*
        pub struct $name:ident {
            options:
            $($(#[doc = $option_doc:tt])* $(#[serde($serde:meta)])? #[arg($($option_arg:tt)*)]
            pub $option:ident: $option_type:ty = $option_default:expr,)*
            both:
            $($(#[doc = $both_doc:tt])* #[arg($($both_arg:tt)*)]
            pub $both:ident: $both_type:ty = $both_default:expr,)*
            settings:
            $($(#[doc = $doc:tt])* pub $setting:ident: $type:ty = $default:expr,)*
        }
    ) => {
        $(#[$meta])*
        pub struct $name {
            $($(#[doc = $option_doc])* $(#[serde($serde)])? #[serde(skip_serializing)]
            #[cfg_attr(feature = "cli", arg($($option_arg)*))]
            pub $option: $option_type,)*
            $($(#[doc = $both_doc])* #[cfg_attr(feature = "cli", arg($($both_arg)*))]
            pub $both: $both_type,)*
            $($(#[doc = $doc])* #[serde(skip_deserializing)]
            #[cfg_attr(feature = "cli", arg(skip = { let default: $type = $default; default }))]
            pub $setting: $type,)*
        }

        impl Default for $name {
            fn default() -> Self {
                $name {
                    $($option: $option_default,)*
                    $($both: $both_default,)*
                    $($setting: $default,)*
                }
            }
        }

        impl $name {
            /// Sets the field that `--set` calls `key`.
            fn set_field(&mut self, key: &str, value: toml::Value) -> Result<(), toml::de::Error> {
                match key {
                    $(stringify!($both) => self.$both = value.try_into()?,)*
                    $(stringify!($setting) => self.$setting = value.try_into()?,)*
                    _ => {
                        let keys = &[$(stringify!($both),)* $(stringify!($setting)),*];
                        return Err(serde::de::Error::unknown_field(key, keys));
                    }
                }
                Ok(())
            }
        }
    };
}

options_struct! {
    /// Options of a session, which the program reads from its command line and the Python package from its arguments, and settings of the
    /// method. Learning rates are those of Adam. The unit of lengths is the median depth of the scene.
    #[derive(Debug, Clone, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    #[cfg_attr(feature = "cli", derive(clap::Args))]
    #[allow(non_snake_case)] // gsplat's name for the higher spherical harmonics
    pub struct RefineOptions {
        options:
        /// Number of Gaussians, not allowed with --splat. auto: 16384 to 1000000, by --seconds, the number of cores and the photos; 16384
        /// with --steps
        #[arg(long, value_name = "N|auto", default_value = "auto", value_parser = parse_gaussians)]
        // A plain `Option` would be an option that may be missing.
        pub gaussians: std::option::Option<usize> = None,
        /// Total time in seconds, from the start of the program to its end
        #[arg(long, value_name = "S", default_value_t = DEFAULT_SECONDS, conflicts_with = "steps")]
        pub seconds: f64 = DEFAULT_SECONDS,
        /// Number of steps, instead of a time: the same steps and seed give the same bytes
        #[arg(long, value_name = "N")]
        pub steps: Option<u64> = None,
        /// Seed of the random numbers
        #[arg(long, value_name = "S", default_value_t = 0)]
        pub seed: u64 = 0,
        /// Views to hold out and score: every:N, every:N+K, or none for only the capture's own test split
        #[arg(long, value_name = "WHICH", default_value = "none")]
        pub holdout: Holdout = Holdout::None,
        /// Maximum number of the other views, spread along the camera path; by default as many as fit into about 2 GB of memory
        #[serde(rename(deserialize = "views"))]
        #[arg(long = "views", value_name = "N")]
        pub max_views: Option<usize> = None,
        /// Size of the photos: the longer side to which larger ones are downscaled, as in 1600, or WxH, to which all are cropped and
        /// resized; by default 512, with more than 25,000 Gaussians 1024, and with more than 250,000 1600
        #[arg(long, value_name = "N|WxH")]
        pub size: Option<PhotoSize> = None,
        /// Also optimize a correction of each camera's pose
        #[arg(long)]
        pub correct_poses: bool = false,
        /// Also optimize a gain of red, green and blue for each photo. auto: if the exposures of neighboring photos differ, which is
        /// measured together with depths, never with --splat; without a value: on
        #[arg(long, value_name = "WHEN", default_value = "auto", default_missing_value = "on", num_args = 0..=1, require_equals = true)]
        pub correct_exposures: ExposureCorrection = ExposureCorrection::Auto,
        /// Background of masked pixels instead of ignoring them, so that the splat stays empty there
        #[arg(long, value_enum, value_name = "COLOR")]
        pub mask_background: Option<MaskBackground> = None,
        /// Override a setting of the method, as in views=4; docs/configuration.md lists them
        #[arg(long, value_name = "KEY=VALUE")]
        pub set: Vec<String> = vec![],
        /// Start of the time budget; if it is `None`, the start of the session.
        #[serde(skip_deserializing)]
        #[arg(skip)]
        pub started: Option<Instant> = None,
        /// Device of the depth estimation and the optimization.
        #[serde(skip_deserializing)]
        #[arg(skip = Device::Cpu)]
        pub device: Device = Device::Cpu,

        both:
        /// Optimize the splat for antialiased rendering, which looks right at smaller sizes and from afar, too. The file is marked, and
        /// viewers have to support it: others show the splat slightly worse
        #[arg(long)]
        pub antialiased: bool = false,

        settings:
        /// Number of views in a step.
        pub views: usize = 1,
        /// Fractions of the optimization at which the width and height of images double, up to the full size after the last fraction. By
        /// default there are two, which depend on the full size: images of 240 pixels or more show enough for most of the steps.
        pub resolution_schedule: Option<Vec<f64>> = None,
        /// Final degree of the spherical harmonics. By default it is 2 for more than 100,000 Gaussians and else 1.
        pub sh_degree: Option<i64> = None,
        /// Interval between increases of the degree of the spherical harmonics by one, as a fraction of the optimization. By default it is 0.3
        /// up to degree 1, and 0.2 up to higher degrees.
        pub sh_every: Option<f64> = None,
        /// Initial learning rate of the means, in scene depths, for up to 16,384 Gaussians. For N it is multiplied by (16,384 / N)^0.75.
        pub lr_means: f64 = 2e-3,
        /// Final learning rate of the means, relative to the initial one. The decay is exponential.
        pub lr_means_final_factor: f64 = 0.02,
        /// Learning rate of the logarithms of scales.
        pub lr_scales: f64 = 2e-2,
        /// Learning rate of the quaternions.
        pub lr_quats: f64 = 2e-3,
        /// Learning rate of the logits of opacities.
        pub lr_opacities: f64 = 3e-2,
        /// Learning rate of the spherical harmonics of degree 0.
        pub lr_sh0: f64 = 5e-3,
        /// Learning rate of the higher spherical harmonics, relative to that of degree 0.
        pub lr_shN_factor: f64 = 0.1,
        /// Final value of all other learning rates of Gaussians, relative to the initial ones. The decay is exponential.
        pub lr_final_factor: f64 = 0.6,
        /// Initial learning rate of the cameras' rotations, in radians, and translations, in scene depths, if poses are corrected, for photos of up
        /// to 256 pixels. For N pixels it is multiplied by 256 / N. It falls to a fifth.
        pub lr_poses: f64 = 5e-4,
        /// Initial learning rate of the logarithms of exposures, if exposures are corrected. It falls to a fifth.
        pub lr_exposures: f64 = 5e-3,
        /// Weight of the loss 1 − SSIM. The weight of the L1 loss is one minus this.
        pub ssim_weight: f64 = 0.4,
        /// Weight of the penalty on the mean opacity.
        pub opacity_reg: f64 = 1e-3,
        /// Weight of the penalty on the mean scale in scene depths.
        pub scale_reg: f64 = 0.,
        /// Weight of the loss [`crate::loss::depth_smoothness`].
        pub depth_smoothness_weight: f64 = 0.7,
        /// Initial weight of the relative difference between rendered depths and those on which the photos agree. It falls to 0 in the first half
        /// of the optimization.
        pub depth_weight: f64 = 1.,
        /// Initial number of Gaussians from photos, as a fraction of the final one.
        pub initial_gaussians: f64 = 0.2,
        /// Fraction of the optimization after which the number of Gaussians no longer grows.
        pub grow_until: f64 = 0.6,
        /// Number of steps between relocations of dead Gaussians; 0 disables relocation.
        pub relocate_every: u64 = 50,
        /// Displacement of relocated Gaussians, in standard deviations of the Gaussian that they are moved onto.
        pub relocation_noise: f64 = 0.7,
        /// Opacity at or below which a Gaussian is dead.
        pub prune_opacity: f64 = 0.01,
        /// Fraction of the optimization after which Gaussians are no longer relocated, and their parameters are averaged.
        pub relocate_until: f64 = 0.8,
    }
}

/// Condition for the correction of exposures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
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
fn parse_gaussians(text: &str) -> Result<Option<usize>, String> {
    const MAX: usize = 10_000_000;
    match text.parse() {
        _ if text == "auto" => Ok(None),
        Ok(count) if (1..=MAX).contains(&count) => Ok(Some(count)),
        _ => Err(format!("expected 1 to {MAX}, or auto")),
    }
}

impl RefineOptions {
    /// Returns the number of steps, or the time, which includes reading the photos, the start, the scores, and writing the splat.
    pub fn budget(&self) -> Budget {
        let time = || Budget::Time(Duration::from_secs_f64(self.seconds));
        self.steps.map_or_else(time, Budget::Steps)
    }

    /// Checks that every option is in its range, and returns the options with the settings that [`RefineOptions::set`] overrides, each of
    /// which is `key=value` with a TOML value. `from_splat` selects the defaults for a start from a splat, which needs no small images and no
    /// opacity penalty.
    ///
    /// # Errors
    /// Fails if an option is out of range, if a key is unknown, or if a value has the wrong type or is out of range.
    pub fn resolve(&self, from_splat: bool) -> Result<Self> {
        let mut options = self.clone();
        if from_splat {
            (options.resolution_schedule, options.sh_degree) = (Some(vec![]), Some(1));
            options.opacity_reg = 0.;
        }
        for assignment in &self.set {
            let error = |why: &str| Error::request(format!("--set {assignment}: {why}"));
            let table = assignment.parse().unwrap_or(toml::Table::new());
            let (1, Some((key, value))) = (table.len(), table.into_iter().next()) else {
                return Err(error("expected KEY=VALUE"));
            };
            options.set_field(&key, value).map_err(|e| error(&e.message().replace('\n', " ")))?;
            options.check_settings().map_err(|expected| error(&format!("expected {expected}")))?;
        }
        options.antialiased |= self.antialiased;
        // NaN is refused, too.
        if !(self.seconds > 0. && self.seconds <= MAX_SECONDS) {
            return Err(Error::setting("seconds", self.seconds, "more than 0, up to a year"));
        }
        if self.gaussians == Some(0) {
            return Err(Error::setting("gaussians", 0, "1 or more"));
        }
        if let Some(views @ ..2) = self.max_views {
            return Err(Error::setting("views", views, "2 or more"));
        }
        Ok(options)
    }

    /// Returns the options that a refinement shares with the one that it continues, by name: all that change the result, except for the
    /// budget, the number of Gaussians and the size of the photos, which may grow, and `antialiased`, which stays.
    pub(super) fn fixed_settings(&self) -> BTreeMap<String, Value> {
        let mut settings = json!(self);
        let RefineOptions { seed, correct_poses, correct_exposures, mask_background, .. } = self;
        settings["seed"] = json!(seed);
        settings["correct_poses"] = json!(correct_poses);
        settings["correct_exposures"] = json!(correct_exposures);
        settings["mask_background"] = json!(mask_background);
        let settings = settings.as_object().expect("a struct").clone();
        settings.into_iter().filter(|(name, _)| name != "antialiased").collect()
    }

    /// Checks that every setting is in the range that the method supports. Returns the expected range of the first that isn't.
    fn check_settings(&self) -> Result<(), &'static str> {
        let rates = [
            self.lr_means,
            self.lr_scales,
            self.lr_quats,
            self.lr_opacities,
            self.lr_sh0,
            self.lr_shN_factor,
            self.lr_poses,
            self.lr_exposures,
            self.relocation_noise,
        ];
        let factors = [self.lr_means_final_factor, self.lr_final_factor, self.initial_gaussians];
        let weights = [self.opacity_reg, self.scale_reg, self.depth_smoothness_weight, self.depth_weight];
        let is_inner_fraction = |&fraction: &f64| 0. < fraction && fraction < 1.;
        let is_fraction = |fraction: &f64| (0. ..=1.).contains(fraction);
        let schedule = self.resolution_schedule.as_deref().unwrap_or_default();
        // Comparisons with NaN are false, so NaN fails every rule.
        let rules = [
            (self.views >= 1, "1 or more"),
            (schedule.len() <= MAX_SIZES, "8 sizes or fewer"),
            (schedule.iter().all(is_inner_fraction), "numbers above 0 and below 1"),
            (schedule.is_sorted_by(|a, b| a < b), "numbers that increase"),
            (self.sh_degree.is_none_or(|degree| (0..=3).contains(&degree)), "0 to 3"),
            (self.sh_every.is_none_or(|every| 0. < every && every.is_finite()), "a finite number above 0"),
            (rates.iter().all(|rate| (0. ..=10.).contains(rate)), "0 to 10"),
            (factors.iter().all(|&factor| 0. < factor && factor <= 1.), "above 0, up to 1"),
            (weights.iter().all(|weight| (0. ..=1000.).contains(weight)), "0 to 1000"),
            (is_inner_fraction(&self.grow_until), "above 0 and below 1"),
            ([self.ssim_weight, self.relocate_until].iter().all(is_fraction), "0 to 1"),
            ((0. ..1.).contains(&self.prune_opacity), "0 or more, below 1"),
        ];
        rules.into_iter().find(|(is_met, _)| !is_met).map_or(Ok(()), |(_, expected)| Err(expected))
    }

    /// Returns a number of Gaussians that suits the time budget, the number of cores, and the photos of `capture`. Without a time budget it
    /// depends on nothing.
    pub(super) fn gaussians_for(&self, capture: &Capture) -> usize {
        let Budget::Time(time) = self.budget() else { return MIN_GAUSSIANS };
        let cores = std::thread::available_parallelism().map_or(1., |cores| cores.get() as f64);
        let by_time = GAUSSIANS_PER_CORE_SECOND * cores * time.as_secs_f64().min(MAX_SECONDS_OF_GROWTH);
        let (cameras, (train, _)) = (capture.cameras(), capture.split(self.holdout));
        let pixels = |&index: &usize| {
            let ImageSize { height, width } = PhotoSize::Within(LARGEST_SIDE).of(&cameras[index]);
            u64::from(height) * u64::from(width)
        };
        let by_pixels = train.iter().map(pixels).sum::<u64>() / PIXELS_PER_GAUSSIAN;
        (by_time.min(by_pixels as f64) as usize).clamp(MIN_GAUSSIANS, MAX_GAUSSIANS)
    }

    /// Returns the size of the photos for a number of Gaussians, by default the one that fits: fewer can't show more detail, and more pixels
    /// take more time.
    pub(super) fn size_for(&self, gaussians: usize) -> PhotoSize {
        self.size.unwrap_or(PhotoSize::Within(match gaussians {
            ..=25_000 => 512,
            25_001..=250_000 => 1024,
            _ => LARGEST_SIDE,
        }))
    }

    /// Returns the number of Gaussians to create from photos, from which their number grows to `count`.
    pub(super) fn initial_gaussians_for(&self, count: usize) -> usize {
        match self.steps {
            Some(..MIN_STEPS_TO_GROW) => count,
            _ => (count as f64 * self.initial_gaussians).ceil() as usize,
        }
    }

    /// Returns the final degree of the spherical harmonics of `count` Gaussians.
    pub(super) fn sh_degree_for(&self, count: i64) -> i64 {
        self.sh_degree.unwrap_or(if count > MANY_GAUSSIANS { 2 } else { 1 })
    }

    /// Returns the interval between increases of the degree up to `degree`, as a fraction of the optimization.
    pub(super) fn sh_every_for(&self, degree: i64) -> f64 {
        self.sh_every.unwrap_or(if degree > 1 { 0.2 } else { 0.3 })
    }

    /// Returns the learning rate of poses for photos of `longest_side` pixels.
    pub(super) fn lr_poses_for(&self, longest_side: u32) -> f64 {
        self.lr_poses * (POSES_SIDE / f64::from(longest_side)).min(1.)
    }

    /// Returns the longer side in pixels at which photos are compared to find their depths. Larger ones show thin things, but take time from
    /// the steps.
    pub(super) fn sweep_side(&self) -> f64 {
        let is_short = match self.budget() {
            Budget::Steps(steps) => steps < MIN_STEPS_OF_LARGE_SWEEP,
            Budget::Time(time) => time < MIN_TIME_OF_LARGE_SWEEP,
        };
        if is_short { SWEEP_SIDE } else { 2. * SWEEP_SIDE }
    }

    /// Returns the weight of known depths, which falls to 0 in the first half: later the photos decide.
    pub(super) fn depth_weight_at(&self, progress: f64) -> f64 {
        self.depth_weight * (1. - 2. * progress).max(0.)
    }

    /// Returns the fractions of the optimization at which the width and height of photos double, up to `longest_side` pixels. Small photos save
    /// time, but hide detail: 240 pixels or more are enough for most of the steps.
    pub(super) fn schedule(&self, longest_side: u32) -> Vec<f64> {
        let by_size = || match longest_side {
            ..480 => vec![0.03, 0.1],
            480..960 => vec![0.03, 0.4],
            _ => vec![0.4, 0.7],
        };
        self.resolution_schedule.clone().unwrap_or_else(by_size)
    }

    /// Returns the indices of the photos to match, which have `size`, and of the held-out views, and a warning if large captures have more than fit into memory.
    pub(super) fn select_views(
        &self,
        capture: &Capture,
        size: PhotoSize,
    ) -> ([Vec<usize>; 2], Option<String>) {
        let cameras = capture.cameras();
        let (all_train, all_held_out) = capture.split(self.holdout);
        let bytes = |camera: &Camera| {
            let ImageSize { height, width } = size.of(camera);
            BYTES_PER_PIXEL * u64::from(height) * u64::from(width)
        };
        let largest = cameras.iter().map(bytes).max().unwrap_or(1);
        let fitting = |bytes: u64| (bytes / largest).max(2) as usize;
        let train =
            spread_over_path(&cameras, &all_train, self.max_views.unwrap_or(fitting(MAX_PHOTO_BYTES)));
        let held_out = spread_over_path(&cameras, &all_held_out, fitting(MAX_HELD_OUT_BYTES));
        let is_limited = (self.max_views.is_none() && train.len() < all_train.len())
            || held_out.len() < all_held_out.len();
        let warning = is_limited.then(|| {
            format!(
                "{}: {} of {} photos are matched and {} of {} scored, spread along the camera path, as more need more than about 2 GB of memory",
                capture.name,
                train.len(),
                all_train.len(),
                held_out.len(),
                all_held_out.len()
            )
        });
        ([train, held_out], warning)
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

    /// Returns a capture of `count` photos along a line.
    fn walk(width: u32, height: u32, count: i32) -> Capture {
        let k = f64::from(width);
        let intrinsics = Intrinsics { fx: k, fy: k, cx: k / 2., cy: f64::from(height) / 2. };
        let camera = |index: i32| {
            let c2w = DMat4::from_translation(DVec3::X * f64::from(index));
            Camera { intrinsics, c2w, width, height }
        };
        let cameras: Vec<Camera> = (0..count).map(camera).collect();
        Capture::from_source("walk".into(), "".into(), &cameras, Arc::new(NoImages)).unwrap()
    }

    #[test]
    fn large_captures_are_limited_to_what_fits_into_memory() {
        let capture = walk(1600, 1200, 2000);
        let every_8 = Holdout::Every { every: 8, first: 0 };
        // Photos of 1024×768 pixels take 4 bytes for each.
        let limited = Some("walk: 426 of 1750 photos are matched and 85 of 250 scored");
        let small = PhotoSize::Exactly([96, 128].into());
        for (holdout, max_views, size, counts, expected) in [
            (every_8, None, PhotoSize::Within(1024), [426, 85], limited),
            (every_8, None, small, [1750, 250], None),
            (Holdout::None, Some(500), PhotoSize::Within(1024), [500, 0], None),
        ] {
            let options = RefineOptions { holdout, max_views, ..Default::default() };
            let (selected, warning) = options.select_views(&capture, size);
            assert_eq!(selected.map(|views| views.len()), counts);
            let is_expected = |line: &String| expected.is_some_and(|expected| line.starts_with(expected));
            assert!(
                warning.iter().all(is_expected) && warning.is_some() == expected.is_some(),
                "{warning:?}"
            );
        }
    }

    #[test]
    fn the_number_of_gaussians_grows_if_there_is_time() {
        for (steps, count, expected) in [(None, 16_384, 3277), (Some(500), 101, 21), (Some(499), 101, 101)] {
            let options = RefineOptions { steps, ..Default::default() };
            assert_eq!(options.initial_gaussians_for(count), expected);
        }
    }

    #[test]
    fn the_number_of_gaussians_suits_time_and_photos() {
        let (large, small) = (walk(1000, 1000, 50), walk(256, 256, 9));
        let after = |seconds: f64, capture: &Capture| {
            RefineOptions { seconds, ..RefineOptions::default() }.gaussians_for(capture)
        };
        let minute = after(60., &large);
        assert!((16_384..=1_000_000).contains(&minute));
        assert_eq!(after(1., &large), 16_384);
        // After four minutes more time is for more steps.
        for (seconds, factor) in [(120., 2), (240., 4), (100_000., 4)] {
            let count = after(seconds, &large);
            assert!(count == (factor * minute).min(1_000_000) || minute == 16_384, "{minute} {count}");
        }
        // A Gaussian for 24 pixels.
        assert_eq!(after(100_000., &small), 256 * 256 * 9 / 24);
        let steps = RefineOptions { steps: Some(100_000), ..RefineOptions::default() };
        assert_eq!(steps.gaussians_for(&large), 16_384);
    }

    #[test]
    fn options_out_of_range_are_refused() {
        let default = RefineOptions::default;
        assert!(default().resolve(false).is_ok());
        for (options, expected) in [
            (RefineOptions { seconds: 0., ..default() }, "seconds is 0, expected more than 0"),
            (RefineOptions { seconds: f64::NAN, ..default() }, "seconds is NaN, expected more than 0"),
            (RefineOptions { gaussians: Some(0), ..default() }, "gaussians is 0, expected 1 or more"),
            (RefineOptions { max_views: Some(1), ..default() }, "views is 1, expected 2 or more"),
        ] {
            let error = options.resolve(false).unwrap_err();
            assert!(error.is_invalid_request() && error.to_string().contains(expected), "{error}");
        }
    }

    /// JSON, in which the Python package passes options, has the number of photos as `views`, and settings in `set` alone.
    #[test]
    fn json_has_the_options_of_the_command_line() {
        let read = |text: &str| serde_json::from_str::<RefineOptions>(text);
        let options = read(r#"{"views": 4, "antialiased": true, "set": ["views=2"]}"#).unwrap();
        let resolved = options.resolve(false).unwrap();
        assert_eq!((resolved.max_views, resolved.views, resolved.antialiased), (Some(4), 2, true));
        assert!(read(r#"{"lr_means": 0.1}"#).is_err());
    }

    #[test]
    fn many_gaussians_have_spherical_harmonics_of_degree_2() {
        let plan = |overrides: &[String], from_splat: bool, count: i64| {
            let options =
                RefineOptions { set: overrides.into(), ..Default::default() }.resolve(from_splat).unwrap();
            let degree = options.sh_degree_for(count);
            (degree, options.sh_every_for(degree))
        };
        assert_eq!([100_000, 100_001].map(|count| plan(&[], false, count)), [(1, 0.3), (2, 0.2)]);
        assert_eq!(plan(&[], true, 1_000_000), (1, 0.3));
        assert_eq!(plan(&["sh_degree=3".into(), "sh_every=0.1".into()], false, 10), (3, 0.1));
    }

    #[test]
    fn invalid_overrides_are_refused() {
        let with = |assignment: &str| {
            RefineOptions { set: vec![assignment.into()], ..Default::default() }.resolve(false)
        };
        for (assignment, expected) in [
            ("views=0", "expected 1 or more"),
            ("views=-1", "invalid"),
            ("views=\"a\"", "invalid"),
            ("views", "expected KEY=VALUE"),
            ("resolution_schedule=[0.1, 0.1]", "expected numbers that increase"),
            ("resolution_schedule=[0.3, 0.1]", "expected numbers that increase"),
            ("resolution_schedule=[0.1, nan]", "expected numbers above 0 and below 1"),
            ("resolution_schedule=[1.0]", "expected numbers above 0 and below 1"),
            ("resolution_schedule=[.01, .02, .03, .04, .05, .06, .07, .08, .09]", "expected"),
            ("sh_degree=4", "expected 0 to 3"),
            ("sh_degree=-1", "expected 0 to 3"),
            ("sh_every=0", "expected a finite number above 0"),
            ("sh_every=nan", "expected a finite number above 0"),
            ("sh_every=inf", "expected a finite number above 0"),
            ("lr_means=-1e-3", "expected 0 to 10"),
            ("lr_means=1e30", "expected 0 to 10"),
            ("lr_shN_factor=nan", "expected 0 to 10"),
            ("lr_means_final_factor=0", "expected above 0, up to 1"),
            ("lr_final_factor=inf", "expected above 0, up to 1"),
            ("ssim_weight=1.5", "expected 0 to 1"),
            ("depth_smoothness_weight=-1", "expected 0 to 1000"),
            ("prune_opacity=1", "expected 0 or more, below 1"),
            ("prune_opacity=-1", "expected 0 or more, below 1"),
            ("relocate_until=nan", "expected 0 to 1"),
            ("grow_until=1.0", "expected above 0 and below 1"),
            ("initial_gaussians=0.0", "expected above 0, up to 1"),
            ("relocation_noise=-1", "expected 0 to 10"),
            ("relocate_every=-1", "invalid"),
            ("views=", "expected KEY=VALUE"),
            ("", "expected KEY=VALUE"),
            ("views=1\nlr_means=0.1", "expected KEY=VALUE"),
            ("view=3", "unknown field"),
        ] {
            let message = with(assignment).expect_err(assignment).to_string();
            assert!(message.starts_with(&format!("--set {assignment}: ")), "{message}");
            assert!(message.contains(expected), "{message}");
        }
        assert_eq!(with("resolution_schedule=[]").unwrap().schedule(1024), [0.; 0]);
        assert_eq!(with("relocate_every=0").unwrap().relocate_every, 0);
        assert_eq!(RefineOptions::default().check_settings(), Ok(()));
        assert_eq!(RefineOptions::default().resolve(true).unwrap().check_settings(), Ok(()));
    }

    #[test]
    fn most_steps_are_on_small_but_detailed_photos() {
        let schedule = |side| RefineOptions::default().schedule(side);
        assert_eq!(schedule(256), [0.03, 0.1]);
        assert_eq!(schedule(512), [0.03, 0.4]);
        assert_eq!(schedule(1024), [0.4, 0.7]);
    }
}
