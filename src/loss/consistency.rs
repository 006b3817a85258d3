//! L_con: the Gaussians of two subsets of the photos must agree in geometry (spec 7.7).

use super::mask::MIN_WEIGHT;
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
/// result is a scalar, this share's part of the step's loss. Means are weighted by the target views' `mask` [B, C, 1, H, W] if there is one
/// (spec 7.9).
pub fn consistency(
    alpha: [&Tensor; 2],
    depth: [&Tensor; 2],
    mask: Option<&Tensor>,
    (alpha_factor, depth_factor): (f64, f64),
    share: &StepFraction,
) -> Tensor {
    let distance = symmetric_distance(alpha);
    let opacity = match mask {
        Some(mask) => {
            let mask = mask.squeeze_dim(2);
            let scene_means = |t: Tensor| t.mean_dim([1i64, 2, 3].as_slice(), false, None::<Kind>);
            let weighted = scene_means(distance * &mask) / scene_means(mask).clamp_min(MIN_WEIGHT);
            weighted.mean(None::<Kind>)
        }
        None => distance.mean(None::<Kind>),
    } * share.scenes;
    let both = compared(alpha, mask, depth[0].kind());
    let sum = (symmetric_distance(depth) * &both).sum(None::<Kind>);
    let depth = match &share.depth_pixels {
        Some(count) => sum / count.clamp_min(1.),
        None => sum / both.sum(None::<Kind>).clamp_min(1.),
    };
    opacity * alpha_factor + depth * depth_factor
}

/// Counts the pixels whose depth is compared, each by its weight in `mask` [B, C, 1, H, W]; returns a scalar of `alpha`'s kind.
pub fn depth_pixels(alpha: [&Tensor; 2], mask: Option<&Tensor>) -> Tensor {
    compared(alpha, mask, alpha[0].kind()).sum(None::<Kind>)
}

/// Returns the weight of every pixel whose depth is compared, and 0 for the others, [B, C, H, W].
fn compared(alpha: [&Tensor; 2], mask: Option<&Tensor>, kind: Kind) -> Tensor {
    let opaque_in_both = alpha[0].gt(MIN_ALPHA).logical_and(&alpha[1].gt(MIN_ALPHA)).to_kind(kind);
    match mask {
        Some(mask) => opaque_in_both * mask.squeeze_dim(2),
        None => opaque_in_both,
    }
}

fn symmetric_distance([x, y]: [&Tensor; 2]) -> Tensor {
    ((x - y.detach()).abs() + (y - x.detach()).abs()) * 0.5
}
