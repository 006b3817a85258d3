//! L_dec: keeps the decoder's raw numbers in a range where they can be learned (spec 7.6).

use crate::model::RawOutputs;
use tch::{Kind, Tensor};

/// The term's own factor.
const FACTOR: f64 = 1e-2;
/// Spherical harmonics beyond it are penalized, softly.
const SH_CAP: f64 = 5.;
/// Opacities beyond it are penalized.
const OPACITY_THRESHOLD: f64 = 0.2;

/// L_dec and what it is made of, all scalars.
#[derive(Debug)]
pub struct DecoderRegularization {
    /// 1e-2 times the sum of the others.
    pub total: Tensor,
    /// L_opacity; 0 where it is left out.
    pub opacity: Tensor,
    /// L_scale.
    pub scale: Tensor,
    /// L_rot.
    pub rotation: Tensor,
    /// L_SH.
    pub sh: Tensor,
}

/// 1e-2 · (L_scale + L_rot + L_SH), and L_opacity in the sum when `opacity` is set.
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

/// mean softplus(|c| − 5)².
pub fn sh_soft_cap(sh: &Tensor) -> Tensor {
    (sh.abs() - SH_CAP).softplus().square().mean(None::<Kind>)
}
