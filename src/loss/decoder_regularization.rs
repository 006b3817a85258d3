//! L_dec: keeps the decoder's raw numbers in a range where they can be learned (SPEC section 7).

use crate::model::RawOutputs;
use tch::{Kind, Tensor};

/// The term's own factor.
const FACTOR: f64 = 1e-2;
/// Spherical harmonics beyond it are penalized, softly.
const SH_CAP: f64 = 5.;
/// Opacities beyond it are penalized.
const OPACITY_THRESHOLD: f64 = 0.2;

/// 1e-2 · (L_scale + L_rot + L_SH), and L_opacity in the sum when `opacity` is set. A scalar.
pub fn decoder_regularization(raw: &RawOutputs, opacity: bool) -> Tensor {
    let mean = |t: Tensor| t.mean(None::<Kind>);
    let scale = mean((&raw.log_scales - crate::model::MAX_SCALE.ln()).relu().square());
    let rotation = mean(raw.rotations.square());
    let sh = sh_soft_cap(&raw.sh);
    let mut sum = scale + rotation + sh;
    if opacity {
        let logit = (OPACITY_THRESHOLD / (1. - OPACITY_THRESHOLD)).ln();
        sum = sum + mean(raw.opacity_logits.sigmoid()) + mean((&raw.opacity_logits - logit).relu().square());
    }
    sum * FACTOR
}

/// mean softplus(|c| − 5)².
pub fn sh_soft_cap(sh: &Tensor) -> Tensor {
    (sh.abs() - SH_CAP).softplus().square().mean(None::<Kind>)
}
