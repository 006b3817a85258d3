//! L_con: two subsets of the photos have to tell the same geometry (SPEC section 7).

use tch::{Kind, Tensor};

/// Depth is compared where both splats are at least this opaque.
const MIN_ALPHA: f64 = 0.01;

/// `alpha_factor` · L1(A_a, A_b) + `depth_factor` · L1(D_a, D_b), each ½|x − sg(y)| + ½|y − sg(x)|: either side learns
/// from the other, which stands still. Accumulated opacities and depths [B, C, H, W]; the result is a scalar.
pub fn consistency(alpha: [&Tensor; 2], depth: [&Tensor; 2], alpha_factor: f64, depth_factor: f64) -> Tensor {
    let opacity = symmetric_distance(alpha).mean(None::<Kind>);
    let both = alpha[0].gt(MIN_ALPHA).logical_and(&alpha[1].gt(MIN_ALPHA)).to_kind(depth[0].kind());
    let count = both.sum(None::<Kind>).clamp_min(1.);
    let depth = (symmetric_distance(depth) * both).sum(None::<Kind>) / count;
    opacity * alpha_factor + depth * depth_factor
}

fn symmetric_distance([x, y]: [&Tensor; 2]) -> Tensor {
    ((x - y.detach()).abs() + (y - x.detach()).abs()) * 0.5
}
