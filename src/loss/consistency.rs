//! L_con: the Gaussians of two subsets of the photos must agree in geometry (spec 7.7).

use tch::{Kind, Tensor};

/// Part of a training step that one forward pass covers: a step may run the model in slices.
#[derive(Debug)]
pub struct StepFraction {
    /// Fraction of the step's scenes.
    pub scenes: f64,
    /// Number of pixels of the whole step whose depth L_con compares, a scalar; `None` if this pass is the whole step.
    pub depth_pixels: Option<Tensor>,
}

impl StepFraction {
    /// Fraction of a pass that is the whole step.
    pub const WHOLE: StepFraction = StepFraction { scenes: 1., depth_pixels: None };
}

/// Minimum opacity of both splats at a pixel whose depth is compared.
const MIN_ALPHA: f64 = 0.01;

/// Computes `alpha_factor` · L1(A_a, A_b) + `depth_factor` · L1(D_a, D_b), each ½|x − sg(y)| + ½|y − sg(x)|, where sg stops the gradient:
/// either side learns from the other, which is fixed. Accumulated opacities and depths are [B, C, H, W] and those of `share` of a step; the
/// result is a scalar, this share's part of the step's loss.
pub fn consistency(
    alpha: [&Tensor; 2],
    depth: [&Tensor; 2],
    alpha_factor: f64,
    depth_factor: f64,
    share: &StepFraction,
) -> Tensor {
    let opacity = symmetric_distance(alpha).mean(None::<Kind>) * share.scenes;
    let both = opaque_in_both(alpha).to_kind(depth[0].kind());
    let sum = (symmetric_distance(depth) * &both).sum(None::<Kind>);
    let depth = match &share.depth_pixels {
        Some(count) => sum / count.clamp_min(1.),
        None => sum / both.sum(None::<Kind>).clamp_min(1.),
    };
    opacity * alpha_factor + depth * depth_factor
}

/// Counts the pixels whose depth is compared; returns a scalar of `alpha`'s kind.
pub fn depth_pixels(alpha: [&Tensor; 2]) -> Tensor {
    opaque_in_both(alpha).to_kind(alpha[0].kind()).sum(None::<Kind>)
}

fn opaque_in_both(alpha: [&Tensor; 2]) -> Tensor {
    alpha[0].gt(MIN_ALPHA).logical_and(&alpha[1].gt(MIN_ALPHA))
}

fn symmetric_distance([x, y]: [&Tensor; 2]) -> Tensor {
    ((x - y.detach()).abs() + (y - x.detach()).abs()) * 0.5
}
