//! Values of a splat on the host, for the formats that pack each Gaussian into bytes.

use super::invalid::InvalidGaussians;
use super::{Contents, Splat, all_finite};
use crate::error::Result;
use crate::scene::Gaussians;
use std::path::Path;
use tch::Tensor;

/// Values of Gaussians. Each list has one entry per Gaussian, unless noted otherwise.
pub(super) struct Values {
    pub means: Vec<[f32; 3]>,
    /// Linear scales.
    pub scales: Vec<[f32; 3]>,
    /// Quaternions (w, x, y, z), of length 1.
    pub quaternions: Vec<[f32; 4]>,
    /// Opacities in [0, 1].
    pub opacities: Vec<f32>,
    /// Number of spherical harmonics per colour channel.
    pub bases: usize,
    /// Spherical harmonics, Gaussian by Gaussian, basis by basis: red, green and blue.
    pub sh: Vec<[f32; 3]>,
}

impl Values {
    /// Creates empty lists with capacity for `count` Gaussians.
    pub fn with_capacity(count: usize, bases: usize) -> Self {
        Values {
            means: Vec::with_capacity(count),
            scales: Vec::with_capacity(count),
            quaternions: Vec::with_capacity(count),
            opacities: Vec::with_capacity(count),
            bases,
            sh: Vec::with_capacity(count * bases),
        }
    }

    /// Returns the values of `splat`, which is to be written at `path`.
    ///
    /// # Errors
    /// Returns an error if a value isn't finite.
    pub fn of(path: &Path, splat: &Splat) -> Result<Self> {
        let g = &splat.gaussians;
        for tensor in [&g.means, &g.scales, &g.quaternions, &g.opacities, &g.sh] {
            all_finite(path, tensor)?;
        }
        let numbers = |tensor: &Tensor| Vec::<f32>::try_from(tensor.flatten(0, -1));
        Ok(Values {
            means: grouped(&numbers(&g.means)?),
            scales: grouped(&numbers(&g.scales)?),
            quaternions: grouped(&numbers(&g.quaternions)?).into_iter().map(normalized).collect(),
            opacities: numbers(&g.opacities)?.into_iter().map(|opacity| opacity.clamp(0., 1.)).collect(),
            bases: splat.bases() as usize,
            sh: grouped(&numbers(&g.sh)?),
        })
    }

    /// Returns the number of Gaussians.
    pub fn count(&self) -> usize {
        self.means.len()
    }

    /// Returns the spherical harmonics of Gaussian `index`.
    pub fn sh_of(&self, index: usize) -> &[[f32; 3]] {
        &self.sh[index * self.bases..][..self.bases]
    }

    /// Returns the Gaussians as they were read. Gaussians with a value that isn't finite, or a negative scale, are added to the `invalid`
    /// ones that the reader has found.
    pub fn into_contents(self, mut invalid: InvalidGaussians) -> Contents {
        for row in 0..self.count() {
            if invalid.contains(row) {
                continue;
            }
            let mut check = |property: &str, values: &[f32], least: f32| {
                if let Some(&bad) = values.iter().find(|&&value| !(value.is_finite() && value >= least)) {
                    let expected = if bad.is_finite() { "0 or more" } else { "finite numbers" };
                    invalid.add(row, property, || format!("the {property} of Gaussian {row}"), bad, expected);
                }
            };
            check("position", &self.means[row], f32::MIN);
            check("scale", &self.scales[row], 0.);
            check("colour", self.sh_of(row).as_flattened(), f32::MIN);
        }
        let (n, bases) = (self.count() as i64, self.bases as i64);
        let tensor = |values: &[f32], shape: &[i64]| Tensor::from_slice(values).view(shape);
        let gaussians = Gaussians {
            means: tensor(self.means.as_flattened(), &[1, n, 3]),
            scales: tensor(self.scales.as_flattened(), &[1, n, 3]),
            quaternions: tensor(self.quaternions.as_flattened(), &[1, n, 4]),
            opacities: tensor(&self.opacities, &[1, n]),
            sh: tensor(self.sh.as_flattened(), &[1, n, bases, 3]),
        };
        Contents { gaussians, invalid, warnings: vec![] }
    }
}

fn grouped<const N: usize>(values: &[f32]) -> Vec<[f32; N]> {
    values.as_chunks().0.to_vec()
}

/// Normalizes a quaternion to length 1; a quaternion of length 0 is unchanged.
pub(super) fn normalized(quaternion: [f32; 4]) -> [f32; 4] {
    let length = quaternion.iter().map(|&part| f64::from(part).powi(2)).sum::<f64>().sqrt();
    match length > 0. {
        true => quaternion.map(|part| (f64::from(part) / length) as f32),
        false => quaternion,
    }
}
