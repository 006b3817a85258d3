//! Configuration of the refinement. docs/refine.md has the measurements by which the defaults were chosen.

use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// Hyperparameters of the optimization. Learning rates are those of Adam. The unit of lengths is the depth of the scene, which
/// [`super::scene_depth`] computes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[allow(non_snake_case)] // gsplat's name for the higher spherical harmonics
pub struct RefineConfig {
    /// Number of views in a step.
    pub views: usize,
    /// Fractions of the optimization at which the width and height of images double, up to the full size after the last fraction. By
    /// default there are two, which depend on the full size: images of 240 pixels or more show enough for most of the steps.
    pub resolution_schedule: Option<Vec<f64>>,
    /// `true` to optimize a splat for antialiased rendering, see [`Splat::antialiased`](globalsplat_splat_file::Splat::antialiased).
    pub antialiased: bool,
    /// Final degree of the spherical harmonics. By default it is 2 for more than 100,000 Gaussians and else 1.
    pub sh_degree: Option<i64>,
    /// Interval between increases of the degree of the spherical harmonics by one, as a fraction of the optimization. By default it is 0.3
    /// up to degree 1, and 0.2 up to higher degrees.
    pub sh_every: Option<f64>,
    /// Initial learning rate of the means, in scene depths, for up to 16,384 Gaussians. For N it is multiplied by (16,384 / N)^0.75.
    pub lr_means: f64,
    /// Final learning rate of the means, relative to the initial one. The decay is exponential.
    pub lr_means_final_factor: f64,
    /// Learning rate of the logarithms of scales.
    pub lr_scales: f64,
    /// Learning rate of the quaternions.
    pub lr_quats: f64,
    /// Learning rate of the logits of opacities.
    pub lr_opacities: f64,
    /// Learning rate of the spherical harmonics of degree 0.
    pub lr_sh0: f64,
    /// Learning rate of the higher spherical harmonics, relative to that of degree 0.
    pub lr_shN_factor: f64,
    /// Final value of all other learning rates of Gaussians, relative to the initial ones. The decay is exponential.
    pub lr_final_factor: f64,
    /// Initial learning rate of the cameras' rotations, in radians, and translations, in scene depths, if poses are corrected, for photos of up
    /// to 256 pixels. For N pixels it is multiplied by 256 / N. It falls to a fifth.
    pub lr_poses: f64,
    /// Initial learning rate of the logarithms of exposures, if exposures are corrected. It falls to a fifth.
    pub lr_exposures: f64,
    /// Weight of the loss 1 − SSIM. The weight of the L1 loss is one minus this.
    pub ssim_weight: f64,
    /// Weight of the penalty on the mean opacity.
    pub opacity_reg: f64,
    /// Weight of the penalty on the mean scale in scene depths.
    pub scale_reg: f64,
    /// Weight of the loss [`crate::loss::depth_smoothness`].
    pub depth_smoothness_weight: f64,
    /// Initial weight of the relative difference between rendered depths and those on which the photos agree. It falls to 0 in the first half
    /// of the optimization.
    pub depth_weight: f64,
    /// Initial number of Gaussians from photos, as a fraction of the final one.
    pub initial_gaussians: f64,
    /// Fraction of the optimization after which the number of Gaussians no longer grows.
    pub grow_until: f64,
    /// Number of steps between relocations of dead Gaussians; 0 disables relocation.
    pub relocate_every: u64,
    /// Displacement of relocated Gaussians, in standard deviations of the Gaussian that they are moved onto.
    pub relocation_noise: f64,
    /// Opacity at or below which a Gaussian is dead.
    pub prune_opacity: f64,
    /// Fraction of the optimization after which Gaussians are no longer relocated, and their parameters are averaged.
    pub relocate_until: f64,
}

impl Default for RefineConfig {
    fn default() -> Self {
        RefineConfig {
            views: 1,
            resolution_schedule: None,
            antialiased: false,
            sh_degree: None,
            sh_every: None,
            lr_means: 2e-3,
            lr_means_final_factor: 0.02,
            lr_scales: 2e-2,
            lr_quats: 2e-3,
            lr_opacities: 3e-2,
            lr_sh0: 5e-3,
            lr_shN_factor: 0.1,
            lr_final_factor: 0.6,
            lr_poses: 5e-4,
            lr_exposures: 5e-3,
            ssim_weight: 0.4,
            opacity_reg: 1e-3,
            scale_reg: 0.,
            depth_smoothness_weight: 0.7,
            depth_weight: 1.,
            initial_gaussians: 0.2,
            grow_until: 0.6,
            relocate_every: 50,
            relocation_noise: 0.7,
            prune_opacity: 0.01,
            relocate_until: 0.8,
        }
    }
}

/// Longer side of photos, in pixels, from which the learning rate of poses falls.
const POSES_SIDE: f64 = 256.;

/// Minimum longer side of photos, in pixels, that show enough detail for most of the steps.
const DETAILED_SIDE: u32 = 240;

/// Number of Gaussians above which spherical harmonics have degree 2 by default.
const MANY_GAUSSIANS: i64 = 100_000;

/// Maximum number of photo sizes besides the full size.
const MAX_SIZES: usize = 8;

impl RefineConfig {
    /// Returns the defaults with `overrides` applied, each of which is `key=value` with a TOML value. `from_splat` selects the defaults of
    /// [`RefineConfig::from_splat`].
    ///
    /// # Errors
    /// Fails if a key is unknown, or if a value has the wrong type or is out of range.
    pub fn with(overrides: &[String], from_splat: bool) -> Result<Self> {
        let defaults = if from_splat { RefineConfig::from_splat() } else { RefineConfig::default() };
        let mut table = toml::Table::try_from(&defaults).expect("values that TOML can represent");
        for assignment in overrides {
            let error = |why: &str| Error::request(format!("--set {assignment}: {why}"));
            let set: toml::Table = assignment.parse().map_err(|_| error("expected KEY=VALUE"))?;
            if set.len() != 1 {
                return Err(error("expected KEY=VALUE"));
            }
            table.extend(set);
            let config: RefineConfig =
                table.clone().try_into().map_err(|e| error(&e.message().replace('\n', " ")))?;
            config.check().map_err(|expected| error(&format!("expected {expected}")))?;
        }
        Ok(table.try_into().expect("a table that was converted before"))
    }

    /// Checks that every value is in the range that the method supports.
    ///
    /// # Errors
    /// Returns the expected range of the first value that is out of range.
    pub fn check(&self) -> std::result::Result<(), &'static str> {
        let rates = [
            self.lr_means,
            self.lr_scales,
            self.lr_quats,
            self.lr_opacities,
            self.lr_sh0,
            self.lr_shN_factor,
            self.lr_poses,
            self.lr_exposures,
        ];
        let weights = [self.opacity_reg, self.scale_reg, self.depth_smoothness_weight, self.depth_weight];
        let is_inner_fraction = |&fraction: &f64| 0. < fraction && fraction < 1.;
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
            (
                [self.lr_means_final_factor, self.lr_final_factor].iter().all(|&end| 0. < end && end <= 1.),
                "above 0, up to 1",
            ),
            ((0. ..=1.).contains(&self.ssim_weight), "0 to 1"),
            (weights.iter().all(|weight| (0. ..=1000.).contains(weight)), "0 to 1000"),
            ((0. ..1.).contains(&self.prune_opacity), "0 or more, below 1"),
            (is_inner_fraction(&self.grow_until), "above 0 and below 1"),
            (0. < self.initial_gaussians && self.initial_gaussians <= 1., "above 0, up to 1"),
            ((0. ..=10.).contains(&self.relocation_noise), "0 to 10"),
            ((0. ..=1.).contains(&self.relocate_until), "0 to 1"),
        ];
        rules.into_iter().find(|(is_met, _)| !is_met).map_or(Ok(()), |(_, expected)| Err(expected))
    }

    /// Returns the defaults for a start from a splat, which needs no small images and no opacity penalty.
    pub fn from_splat() -> Self {
        RefineConfig {
            resolution_schedule: Some(vec![]),
            sh_degree: Some(1),
            opacity_reg: 0.,
            ..Default::default()
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

    /// Returns the weight of known depths, which falls to 0 in the first half: later the photos decide.
    pub(super) fn depth_weight_at(&self, progress: f64) -> f64 {
        self.depth_weight * (1. - 2. * progress).max(0.)
    }

    /// Returns the fractions of the optimization at which the width and height of photos double, up to `longest_side` pixels.
    pub(super) fn schedule(&self, longest_side: u32) -> Vec<f64> {
        let by_size = || {
            // Small photos save time, but hide detail.
            let part = |side: u32, of: [f64; 2]| of[usize::from(side >= DETAILED_SIDE)];
            let (quarter, half) = (longest_side / 4, longest_side / 2);
            let first = part(quarter, [0.03, 0.4]);
            vec![first, part(half, [0.1, if quarter >= DETAILED_SIDE { 0.7 } else { 0.4 }])]
        };
        self.resolution_schedule.clone().unwrap_or_else(by_size)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_gaussians_have_spherical_harmonics_of_degree_2() {
        let plan = |overrides: &[String], from_splat: bool, count: i64| {
            let config = RefineConfig::with(overrides, from_splat).unwrap();
            let degree = config.sh_degree_for(count);
            (degree, config.sh_every_for(degree))
        };
        assert_eq!([100_000, 100_001].map(|count| plan(&[], false, count)), [(1, 0.3), (2, 0.2)]);
        assert_eq!(plan(&[], true, 1_000_000), (1, 0.3));
        assert_eq!(plan(&["sh_degree=3".into(), "sh_every=0.1".into()], false, 10), (3, 0.1));
    }

    #[test]
    fn invalid_overrides_are_refused() {
        let with = |assignment: &str| RefineConfig::with(&[assignment.to_string()], false);
        for (assignment, expected) in [
            ("views=0", "expected 1 or more"),
            ("views=-1", "invalid"),
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
        assert_eq!(RefineConfig::default().check(), Ok(()));
        assert_eq!(RefineConfig::from_splat().check(), Ok(()));
    }

    #[test]
    fn most_steps_are_on_small_but_detailed_photos() {
        let schedule = |side| RefineConfig::default().schedule(side);
        assert_eq!(schedule(256), [0.03, 0.1]);
        assert_eq!(schedule(512), [0.03, 0.4]);
        assert_eq!(schedule(1024), [0.4, 0.7]);
    }
}
