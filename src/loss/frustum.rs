//! L_fru: pulls Gaussians that no input view can see back into the frustum of some view (spec 7.5).

use crate::data::ViewBatch;
use tch::{Kind, Tensor};

/// Minimum divisor of the projection.
const MIN_DIVISOR: f64 = 1e-6;
/// Near plane: Gaussians with a smaller depth violate the frustum.
const NEAR: f64 = 0.01;
/// Violation, in pixels or units of depth, that counts as one.
const SOFTNESS: f64 = 10.;

/// Computes the mean over Gaussians and scenes of log(1 + v/10), where v is the smallest violation over the views. A violation is the
/// distance of the projection from the image, in pixels, plus the distance of the depth from [0.01, far].
///
/// `means` is [B, N, 3] and `far` is `[B]`. The result is a scalar.
pub fn frustum(means: &Tensor, views: &ViewBatch, far: &Tensor) -> Tensor {
    let (height, width) = (views.images.size()[3], views.images.size()[4]);
    let rotation = views.w2c.narrow(-2, 0, 3).narrow(-1, 0, 3);
    let translation = views.w2c.narrow(-2, 0, 3).narrow(-1, 3, 1).transpose(-1, -2);
    let camera = means.unsqueeze(1).matmul(&rotation.transpose(-1, -2)) + translation; // [B, V, N, 3]
    let pixel = camera.matmul(&views.intrinsics.transpose(-1, -2)); // (f_x x + c_x z, f_y y + c_y z, z)
    let depth = camera.select(-1, 2);
    let divisor = depth.clamp_min(MIN_DIVISOR);
    let outside =
        |coordinate: Tensor, size: i64| (-&coordinate).relu() + (coordinate - (size - 1) as f64).relu();
    let violation = outside(pixel.select(-1, 0) / &divisor, width)
        + outside(pixel.select(-1, 1) / &divisor, height)
        + (-&depth + NEAR).relu()
        + (&depth - far.view([-1, 1, 1])).relu();
    (violation.amin([1i64].as_slice(), false) / SOFTNESS).log1p().mean(None::<Kind>)
}
