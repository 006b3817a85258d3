//! L_con: two subsets of the photos have to tell the same geometry (spec 7.7).

use tch::{Kind, Tensor};

/// What a forward pass is of a training step, which may go through the model in slices.
#[derive(Debug)]
pub struct Share {
    /// Of the step's scenes.
    pub scenes: f64,
    /// Pixels of the whole step whose depth L_con compares, a scalar; none where this pass is the whole step.
    pub depth_pixels: Option<Tensor>,
}

impl Share {
    /// All of it.
    pub const WHOLE: Share = Share { scenes: 1., depth_pixels: None };
}

/// Depth is compared where both splats are at least this opaque.
const MIN_ALPHA: f64 = 0.01;

/// `alpha_factor` · L1(A_a, A_b) + `depth_factor` · L1(D_a, D_b), each ½|x − sg(y)| + ½|y − sg(x)|: either side learns
/// from the other, which stands still. Accumulated opacities and depths [B, C, H, W] of `share` of a step; the result is a
/// scalar, its part of the whole step's.
pub fn consistency(
    alpha: [&Tensor; 2],
    depth: [&Tensor; 2],
    alpha_factor: f64,
    depth_factor: f64,
    share: &Share,
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

/// Pixels whose depth is compared: how many they are, a scalar of `alpha`'s kind.
pub fn depth_pixels(alpha: [&Tensor; 2]) -> Tensor {
    opaque_in_both(alpha).to_kind(alpha[0].kind()).sum(None::<Kind>)
}

fn opaque_in_both(alpha: [&Tensor; 2]) -> Tensor {
    alpha[0].gt(MIN_ALPHA).logical_and(&alpha[1].gt(MIN_ALPHA))
}

fn symmetric_distance([x, y]: [&Tensor; 2]) -> Tensor {
    ((x - y.detach()).abs() + (y - x.detach()).abs()) * 0.5
}
