//! The splat as plain arrays.

use crate::rotations::{drop_missing_rotations, normalized};
use crate::{Error, Result};
use glam::DVec3;
use std::borrow::Cow;
use std::fmt::Display;

/// Spherical harmonic Y_0, which converts between a color and an SH coefficient: color = ½ + `SH_C0` · coefficient.
pub const SH_C0: f64 = 0.28209479177387814;
/// Minimum scale that a PLY is written with, so that logarithms are finite.
pub const MIN_SCALE: f64 = 1e-30;
/// Minimum distance of opacities from 0 and 1 that a PLY is written with, so that logits are finite.
pub const OPACITY_MARGIN: f64 = 1e-6;

/// Contents of a splat file: the Gaussians of one scene, with the parameters that 3DGS stores. All lists have one entry per Gaussian,
/// except for [`Splat::sh`]. [`Splat::check_lengths`] finds lists of other lengths.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Splat {
    /// Centers relative to `origin`.
    pub means: Vec<[f32; 3]>,
    /// Natural logarithms of the scales, which are standard deviations along the Gaussian's own axes. A scale of 0 has the logarithm −∞.
    pub log_scales: Vec<[f32; 3]>,
    /// Scales whose logarithms, rounded to float32, are `log_scales`. They are present if the splat comes from linear scales, as in a
    /// `.splat`, which the logarithms alone would change by a few units in the last place. `None` if the logarithms are exact, as in a PLY.
    /// Set it to `None` when you change `log_scales`.
    pub linear_scales: Option<Vec<[f32; 3]>>,
    /// Rotations as quaternions (w, x, y, z) of any length.
    pub quaternions: Vec<[f32; 4]>,
    /// Logits of the opacities. Opacities of 0 and 1 have the logits −∞ and ∞.
    pub opacity_logits: Vec<f32>,
    /// Spherical harmonics, (degree + 1)² for each Gaussian: Gaussian by Gaussian, basis by basis, each red, green and blue.
    pub sh: Vec<[f32; 3]>,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: usize,
    /// `true` if the opacities are meant for an antialiased renderer: one whose low-pass filter adds ε to the diagonal of a projected
    /// covariance Σ and multiplies the opacity by √(det Σ / det(Σ + ε)), like Mip-Splatting's and gsplat's mode `antialiased`.
    pub antialiased: bool,
    /// Origin of the means in world coordinates: world = origin + mean.
    pub origin: DVec3,
    /// Messages about what was left out or changed when the splat was read or created, a sentence each. Splats derived from it have none.
    pub warnings: Vec<String>,
}

impl Splat {
    /// Maximum degree of the spherical harmonics.
    const MAX_DEGREE: usize = 3;

    /// Creates a splat in world coordinates, with its origin at zero.
    ///
    /// # Errors
    /// Returns an error if the degree is above 3, or if a list doesn't have the length that [`Splat`] requires.
    pub fn new(
        sh_degree: usize,
        means: Vec<[f32; 3]>,
        log_scales: Vec<[f32; 3]>,
        quaternions: Vec<[f32; 4]>,
        opacity_logits: Vec<f32>,
        sh: Vec<[f32; 3]>,
    ) -> Result<Self> {
        let splat =
            Splat { means, log_scales, quaternions, opacity_logits, sh, sh_degree, ..Splat::default() };
        splat.check_lengths()?;
        Ok(splat)
    }

    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Returns `true` if there is no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Returns the number of spherical harmonics per color channel, 1 to 16.
    pub fn bases(&self) -> usize {
        (self.sh_degree + 1).pow(2)
    }

    /// Returns the spherical harmonics of Gaussian `index`, basis by basis.
    ///
    /// # Panics
    /// Panics if there is no such Gaussian.
    pub fn sh_of(&self, index: usize) -> &[[f32; 3]] {
        &self.sh[index * self.bases()..][..self.bases()]
    }

    /// Returns the scales of Gaussian `index`: standard deviations along its own axes.
    ///
    /// # Panics
    /// Panics if there is no such Gaussian.
    pub fn scale(&self, index: usize) -> [f32; 3] {
        match &self.linear_scales {
            Some(scales) => scales[index],
            None => self.log_scales[index].map(|log_scale| f64::from(log_scale).exp() as f32),
        }
    }

    /// Returns the opacity of Gaussian `index`, in [0, 1].
    ///
    /// # Panics
    /// Panics if there is no such Gaussian.
    pub fn opacity(&self, index: usize) -> f32 {
        (1. / (1. + (-f64::from(self.opacity_logits[index])).exp())) as f32
    }

    /// Returns the splat with spherical harmonics up to `degree`: higher coefficients are dropped, missing ones are 0.
    pub fn with_sh_degree(&self, degree: usize) -> Self {
        let bases = (degree + 1).pow(2);
        let kept = self.bases().min(bases);
        let mut sh = Vec::with_capacity(self.len() * bases);
        for index in 0..self.len() {
            sh.extend(&self.sh_of(index)[..kept]);
            sh.resize((index + 1) * bases, [0.; 3]);
        }
        Splat { sh, sh_degree: degree, warnings: vec![], ..self.clone() }
    }

    /// Returns the splat with means relative to `origin`, rounded to float32.
    pub fn with_origin(&self, origin: DVec3) -> Self {
        let mut splat = Splat { origin, warnings: vec![], ..self.clone() };
        if origin != self.origin {
            let by = (self.origin - origin).to_array();
            for mean in &mut splat.means {
                *mean = std::array::from_fn(|axis| (f64::from(mean[axis]) + by[axis]) as f32);
            }
        }
        splat
    }

    /// Returns the splat without the Gaussians whose quaternion has length 0, and with a warning about them that calls the splat `name`.
    /// Quaternions whose length is far from 1 are normalized.
    pub fn without_missing_rotations(self, name: impl Display) -> Self {
        let all = self.len();
        let (rotated, left_out) = drop_missing_rotations(&self);
        let mut splat = match rotated {
            Cow::Owned(rotated) => rotated,
            Cow::Borrowed(_) => self,
        };
        if left_out > 0 {
            splat.warnings.push(format!(
                "{name}: {left_out} of {all} Gaussians are left out, whose rotations have length 0"
            ));
        }
        splat
    }

    /// Returns the Gaussians `indices`, in this order.
    ///
    /// # Panics
    /// Panics if there is no such Gaussian.
    pub fn select(&self, indices: &[usize]) -> Self {
        fn select<T: Copy>(list: &[T], indices: &[usize]) -> Vec<T> {
            indices.iter().map(|&index| list[index]).collect()
        }
        Splat {
            means: select(&self.means, indices),
            log_scales: select(&self.log_scales, indices),
            linear_scales: self.linear_scales.as_ref().map(|scales| select(scales, indices)),
            quaternions: select(&self.quaternions, indices),
            opacity_logits: select(&self.opacity_logits, indices),
            sh: indices.iter().flat_map(|&index| self.sh_of(index)).copied().collect(),
            warnings: self.warnings.clone(),
            ..*self
        }
    }

    /// Returns the Gaussians of both splats, with the origin of the first one that has one, the antialiased mark of the first one, and the
    /// higher SH degree.
    pub fn merged(&self, other: &Self) -> Self {
        if self.origin == DVec3::ZERO && other.origin != DVec3::ZERO {
            return self.with_origin(other.origin).merged(other);
        }
        let joined = Splat::concat(&[self, &other.with_origin(self.origin)]);
        Splat { antialiased: self.antialiased, origin: self.origin, ..joined }
    }

    /// Returns the Gaussians of all `parts`, with spherical harmonics of the highest degree, and linear scales if all have them. Their means
    /// stay as they are.
    pub(crate) fn concat(parts: &[&Splat]) -> Self {
        let sh_degree = parts.iter().map(|part| part.sh_degree).max().unwrap_or(0);
        let is_linear = parts.iter().all(|part| part.linear_scales.is_some());
        let mut all = Splat { sh_degree, linear_scales: is_linear.then(Vec::new), ..Splat::default() };
        let bases = all.bases();
        for part in parts {
            all.means.extend(&part.means);
            all.log_scales.extend(&part.log_scales);
            all.quaternions.extend(&part.quaternions);
            all.opacity_logits.extend(&part.opacity_logits);
            if let Some(scales) = &mut all.linear_scales {
                scales.extend((0..part.len()).map(|index| part.scale(index)));
            }
            for index in 0..part.len() {
                let end = all.sh.len() + bases;
                all.sh.extend(part.sh_of(index));
                all.sh.resize(end, [0.; 3]);
            }
        }
        all
    }

    /// Checks that every list has the length that [`Splat`] requires.
    ///
    /// # Errors
    /// Returns an error if the degree is above 3, or for the first list of another length.
    pub fn check_lengths(&self) -> Result<()> {
        if self.sh_degree > Self::MAX_DEGREE {
            return Err(Error::setting("the SH degree", self.sh_degree, "0 to 3"));
        }
        let (count, bases) = (self.len(), self.bases());
        let lengths = [
            ("log_scales", self.log_scales.len(), count),
            ("linear_scales", self.linear_scales.as_ref().map_or(count, Vec::len), count),
            ("quaternions", self.quaternions.len(), count),
            ("opacity_logits", self.opacity_logits.len(), count),
            ("sh", self.sh.len(), count * bases),
        ];
        match lengths.iter().find(|(_, found, expected)| found != expected) {
            Some((name, found, expected)) => Err(Error::setting(
                format!("the length of {name}"),
                found,
                format!("{expected} for {count} Gaussians of SH degree {}", self.sh_degree),
            )),
            None => Ok(()),
        }
    }

    /// Appends the scales of a Gaussian to both lists of scales. The logarithm of 0 is −∞.
    pub(crate) fn push_linear_scale(&mut self, scale: [f32; 3]) {
        self.log_scales.push(scale.map(|scale| f64::from(scale).ln() as f32));
        self.linear_scales.get_or_insert_default().push(scale);
    }

    /// Returns the rotation of Gaussian `index` as a quaternion of length 1.
    pub(crate) fn unit_quaternion(&self, index: usize) -> [f32; 4] {
        normalized(self.quaternions[index])
    }
}

/// Returns the lower and the upper bounds of the components of `vectors`, which are 0 if there are none.
pub(crate) fn bounds(vectors: &[[f32; 3]]) -> [[f32; 3]; 2] {
    [f32::min as fn(f32, f32) -> f32, f32::max].map(|choose| {
        [0, 1, 2].map(|axis| vectors.iter().map(|vector| vector[axis]).reduce(choose).unwrap_or(0.))
    })
}

/// Returns the logit of an opacity in [0, 1], which is infinite for 0 and 1.
pub(crate) fn logit_of_opacity(opacity: f64) -> f32 {
    (opacity / (1. - opacity)).ln() as f32
}

/// Returns the color, before it is clamped to [0, 1], for an SH coefficient of degree 0.
pub(crate) fn sh0_to_color(coefficient: f32) -> f64 {
    f64::from(coefficient) * SH_C0 + 0.5
}

/// Returns the SH coefficient of degree 0 for a color.
pub(crate) fn color_to_sh0(color: f64) -> f32 {
    ((color - 0.5) / SH_C0) as f32
}
