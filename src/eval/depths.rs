//! Exact depths of a synthetic capture, against which rendered ones are scored.

use crate::data::{Capture, Pixels, read_npy};
use crate::error::{Error, Result};
use std::path::Path;
use tch::{Kind, Tensor};

/// Exact depths of all photos of a capture, [photos, H, W], infinite where nothing is.
#[derive(Debug)]
pub(super) struct ExactDepths(Tensor);

impl ExactDepths {
    /// Reads the depths of `capture` from `file`, a NumPy array of float32 or float64.
    ///
    /// # Errors
    /// Fails if the file can't be read, has another shape than the photos or Fortran's order, or if a depth is below 0 or NaN.
    pub fn read(file: &Path, capture: &Capture) -> Result<Self> {
        let camera = capture.camera(0);
        let expected = [capture.len(), camera.height as usize, camera.width as usize];
        let (found, values) = read_npy(file)?;
        if found != expected {
            let expected = format!("{expected:?}, that of the photos");
            return Err(Error::input(file, "the shape", format!("{found:?}"), expected));
        }
        if let Some(bad) = values.iter().find(|z| z.is_nan() || **z < 0.) {
            return Err(Error::input(file, "a depth", bad, "0 or more, or infinity where nothing is"));
        }
        let depths = Tensor::from_slice(&values).to_kind(Kind::Float);
        Ok(ExactDepths(depths.view(expected.map(|side| side as i64).as_slice())))
    }

    /// Returns the depths of a photo, [H, W].
    pub fn of_photo(&self, photo: usize) -> Tensor {
        self.0.get(photo as i64)
    }
}

/// Returns the mean of |z − z*| / (z + z*) over the pixels that count by `mask` [1, H, W] and have an exact depth z* [H, W], where z is
/// `depth` [H, W].
pub(super) fn depth_error(depth: &Tensor, exact: &Tensor, mask: Option<&Pixels>) -> f64 {
    let mut weight = exact.isfinite().to_kind(Kind::Double);
    if let Some(mask) = mask {
        weight *= mask.to_float().squeeze_dim(0);
    }
    let exact = exact.nan_to_num(0., 0., 0.).to_kind(Kind::Double);
    let error = (depth - &exact).abs() / (depth + &exact).clamp_min(f64::MIN_POSITIVE);
    ((error * &weight).sum(Kind::Double) / weight.sum(Kind::Double)).double_value(&[])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depths_are_compared_where_they_are_known_and_count() {
        let tensor = |values: [f32; 4]| Tensor::from_slice(&values).view([2, 2]);
        let (depth, exact) = (tensor([1., 3., 9., 5.]), tensor([1., 1., f32::INFINITY, 1.]));
        let mask = Pixels::from(tensor([1., 0.5, 1., 0.]).unsqueeze(0));
        assert!((depth_error(&depth, &exact, Some(&mask)) - 0.25 / 1.5).abs() < 1e-9);
        assert!((depth_error(&depth, &exact, None) - (0.5 + 4. / 6.) / 3.).abs() < 1e-9);
    }
}
