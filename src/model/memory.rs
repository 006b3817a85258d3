//! The memory that slots attend to: learned tokens and the image tokens of all views, normalized (spec 4.1), without their common part.

use super::autograd::leaf;
use super::flops::record_flops;
use super::layers::LAYER_NORM_EPS;
use super::precision::Precision;
use tch::{Kind, Tensor};
use tracing::trace_span;

/// Maximum number of views from which the common part is estimated if views are computed one by one, where using all of them costs time.
const VIEWS_OF_MEAN: usize = 4;

/// Normalized tokens, split into a common part and the differences from it. Tokens are much alike: most of what a photo's patches encode of
/// their rays and of their camera is the same for all photos. If only the differences are rounded to 8 bits, scores distinguish thousands
/// of patches as they do in float32.
#[derive(Debug)]
pub struct Memory {
    /// Difference of each token from the common part, [B, m, token width].
    pub tokens: Tensor,
    /// Mean of the tokens, or an estimate of it, [B, 1, token width] in float32, without gradients: the result doesn't depend on what is
    /// taken as the common part.
    pub common: Tensor,
}

impl Memory {
    /// Builds the memory from `tokens` [B, m, token width] in float32. The gradients of all rounds flow back to them and are accumulated in
    /// float32.
    pub(crate) fn new(tokens: &Tensor) -> Self {
        trace_span!("norms").in_scope(|| {
            let tokens = normalized(tokens);
            let common = tokens.detach().mean_dim(1, true, None);
            Memory { tokens: tokens - &common, common }
        })
    }

    /// Builds the memory from `registers` [1, r, token width] and `views` views, for products in `precision`. `view` computes the tokens of
    /// one view, [B, P, token width], and is called for one view after the other. All tokens in float32 would not fit into memory, so a few
    /// views are computed twice: their common part is close to that of all.
    pub(super) fn from_views(
        registers: &Tensor,
        views: i64,
        view: impl Fn(i64) -> Tensor,
        precision: Precision,
    ) -> Self {
        let view = |n| normalized(&view(n));
        let few = (0..views).step_by((views as usize).div_ceil(VIEWS_OF_MEAN)).map(view);
        let mean = |t: &Tensor| trace_span!("norms").in_scope(|| t.mean_dim(1, false, None));
        let (sizes, means): (Vec<_>, Vec<_>) = few.map(|t| (t.size(), mean(&t))).unzip();
        let common = Tensor::stack(&means, 1).mean_dim(1, true, None);

        let (batch, patches, width) = (sizes[0][0], sizes[0][1], sizes[0][2]);
        let learned = registers.size()[1];
        let size = [batch, learned + views * patches, width];
        let tokens = Tensor::empty(size, (precision.kind(), common.device()));
        let put = |first, of: Tensor| {
            trace_span!("norms").in_scope(|| tokens.narrow(1, first, of.size()[1]).copy_(&(of - &common)));
        };
        put(0, normalized(registers));
        (0..views).for_each(|n| put(learned + n * patches, view(n)));
        Memory { tokens, common }
    }

    /// Returns the memory with tokens converted to `kind`.
    pub(super) fn to_kind(&self, kind: Kind) -> Self {
        Memory { tokens: self.tokens.to_kind(kind), common: self.common.shallow_clone() }
    }

    /// Returns the memory with detached tokens that collect gradients.
    pub(super) fn leaf(&self) -> Self {
        Memory { tokens: leaf(&self.tokens), common: self.common.shallow_clone() }
    }
}

/// Normalizes `tokens` without γ and β: the part that the memory norms of all rounds share.
fn normalized(tokens: &Tensor) -> Tensor {
    trace_span!("norms").in_scope(|| {
        let out =
            tokens.layer_norm([tokens.size()[2]], None::<&Tensor>, None::<&Tensor>, LAYER_NORM_EPS, true);
        record_flops(0, 0, &[tokens, &out]);
        out
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use tch::Device;

    /// Returns irregular values between −1 and 1 without random numbers; each `step` gives other values.
    pub(in super::super) fn uneven(step: f64, size: &[i64]) -> Tensor {
        let numbers = Tensor::arange(size.iter().product::<i64>(), (Kind::Double, Device::Cpu));
        (numbers.square() * step).sin().to_kind(Kind::Float).view(size)
    }

    /// Returns tokens [2, `count`, 24] that are close to one another.
    pub(in super::super) fn alike(count: i64) -> Tensor {
        uneven(0.7, &[24]) + 0.05 * uneven(1., &[2, count, 24])
    }

    #[test]
    fn views_make_the_same_memory_one_by_one() {
        let registers = alike(2).get(0).unsqueeze(0);
        let from_views = |views: i64| {
            let tokens = alike(5 * views);
            let view = |n| tokens.narrow(1, 5 * n, 5);
            let all = Tensor::cat(&[&registers.expand([2, -1, -1], false), &tokens], 1);
            (Memory::new(&all), Memory::from_views(&registers, views, view, Precision::F32))
        };
        let largest = |t: Tensor| t.abs().max().double_value(&[]);
        for views in [1, 3, 9] {
            let (at_once, one_by_one) = from_views(views);
            let whole = |memory: &Memory| &memory.tokens + &memory.common;
            assert!(largest(whole(&at_once) - whole(&one_by_one)) < 1e-6, "{views} views");
            // A twentieth of each token is its own, by construction of `alike`.
            let [own, apart] = [&at_once, &one_by_one].map(|memory| largest(memory.tokens.shallow_clone()));
            assert!(apart < 1.5 * own && apart < 0.2 * largest(whole(&at_once)), "{own} {apart}");
        }
    }
}
