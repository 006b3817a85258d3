//! L_dec: keeps the decoder's raw outputs in a range where they can be learned (spec 7.6).

use crate::model::RawOutputs;
use tch::{Kind, Tensor};

/// Factor of the whole term.
const FACTOR: f64 = 1e-2;
/// Magnitude of spherical harmonics above which they are softly penalized.
const SH_CAP: f64 = 5.;
/// Opacity above which opacities are penalized.
const OPACITY_THRESHOLD: f64 = 0.2;

/// L_dec and its parts, all scalars.
#[derive(Debug)]
pub struct DecoderRegularization {
    /// Total of L_dec: 1e-2 times the sum of the parts.
    pub total: Tensor,
    /// Penalty on large opacities, L_opacity; 0 if it is left out.
    pub opacity: Tensor,
    /// Penalty on large scales, L_scale.
    pub scale: Tensor,
    /// Penalty on rotation residuals, L_rot.
    pub rotation: Tensor,
    /// Penalty on large spherical harmonics, L_SH.
    pub sh: Tensor,
}

/// Computes 1e-2 · (L_scale + L_rot + L_SH), with L_opacity in the sum if `opacity` is set.
pub fn decoder_regularization(raw: &RawOutputs, opacity: bool) -> DecoderRegularization {
    let mean = |t: Tensor| t.mean(None::<Kind>);
    let scale = mean((&raw.log_scales - crate::model::MAX_SCALE.ln()).relu().square());
    let rotation = mean(raw.rotations.square());
    let sh = sh_soft_cap(&raw.sh);
    let opacity = match opacity {
        true => {
            let logit = (OPACITY_THRESHOLD / (1. - OPACITY_THRESHOLD)).ln();
            mean(raw.opacity_logits.sigmoid()) + mean((&raw.opacity_logits - logit).relu().square())
        }
        false => scale.zeros_like(),
    };
    let total = (&scale + &rotation + &sh + &opacity) * FACTOR;
    DecoderRegularization { total, opacity, scale, rotation, sh }
}

/// Computes mean softplus(|c| − 5)².
pub fn sh_soft_cap(sh: &Tensor) -> Tensor {
    (sh.abs() - SH_CAP).softplus().square().mean(None::<Kind>)
}
