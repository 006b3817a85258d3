//! What slots look at: learned tokens and those of all images, normalized (spec 4.1), apart from what they have in common.

use super::layers::LAYER_NORM_EPS;
use super::leaves::leaf;
use super::parts::{does, part};
use super::precision::Precision;
use tch::{Kind, Tensor};

/// So many views tell what all have in common, where asking every one costs time.
const VIEWS_OF_MEAN: usize = 4;

/// Tokens are much alike: most of what a photo's patches say of their rays, and of their camera, all photos' do. With 8 bits for
/// what they differ by alone, scores tell thousands of patches apart as they do in float32.
#[derive(Debug)]
pub struct Memory {
    /// What each is beside what they have in common, [B, m, token width].
    pub tokens: Tensor,
    /// Their mean, or nearly so, [B, 1, token width] in float32, whose gradients nobody follows: whatever is called common, the same
    /// comes out.
    pub common: Tensor,
}

impl Memory {
    /// Of `tokens` [B, m, token width] in float32: every round's gradient comes back to them, and is added up in float32.
    pub(crate) fn new(tokens: &Tensor) -> Self {
        part("norms", || {
            let tokens = normalized(tokens);
            let common = tokens.detach().mean_dim(1, true, None);
            Memory { tokens: tokens - &common, common }
        })
    }

    /// The same of `registers` [1, r, token width] and `views` views, of which `view` gives the tokens [B, P, token width], one after
    /// the other, for products in `precision`. There is no room for all in float32, so a few are asked for twice: what these have in
    /// common nearly is what all have.
    pub(super) fn of_views(
        registers: &Tensor,
        views: i64,
        view: impl Fn(i64) -> Tensor,
        precision: Precision,
    ) -> Self {
        let view = |n| normalized(&view(n));
        let few = (0..views).step_by((views as usize).div_ceil(VIEWS_OF_MEAN)).map(view);
        let mean = |t: &Tensor| part("norms", || t.mean_dim(1, false, None));
        let (sizes, means): (Vec<_>, Vec<_>) = few.map(|t| (t.size(), mean(&t))).unzip();
        let common = Tensor::stack(&means, 1).mean_dim(1, true, None);

        let (batch, patches, width) = (sizes[0][0], sizes[0][1], sizes[0][2]);
        let learned = registers.size()[1];
        let size = [batch, learned + views * patches, width];
        let tokens = Tensor::empty(size, (precision.kind(), common.device()));
        let put = |first, of: Tensor| {
            part("norms", || tokens.narrow(1, first, of.size()[1]).copy_(&(of - &common)));
        };
        put(0, normalized(registers));
        (0..views).for_each(|n| put(learned + n * patches, view(n)));
        Memory { tokens, common }
    }

    /// The same with tokens of a `kind`.
    pub(super) fn to_kind(&self, kind: Kind) -> Self {
        Memory { tokens: self.tokens.to_kind(kind), common: self.common.shallow_clone() }
    }

    /// The same where a backward pass ends.
    pub(super) fn leaf(&self) -> Self {
        Memory { tokens: leaf(&self.tokens), common: self.common.shallow_clone() }
    }
}

/// What all rounds' norms of `tokens` have in common, before their γ and β.
fn normalized(tokens: &Tensor) -> Tensor {
    part("norms", || {
        let out =
            tokens.layer_norm([tokens.size()[2]], None::<&Tensor>, None::<&Tensor>, LAYER_NORM_EPS, true);
        does(0, 0, &[tokens, &out]);
        out
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use tch::Device;

    /// Numbers that nobody else draws, between −1 and 1; others for another `step`.
    pub(in super::super) fn uneven(step: f64, size: &[i64]) -> Tensor {
        let numbers = Tensor::arange(size.iter().product::<i64>(), (Kind::Double, Device::Cpu));
        (numbers.square() * step).sin().to_kind(Kind::Float).view(size)
    }

    /// [2, `count`, 24], all of them near one another.
    pub(in super::super) fn alike(count: i64) -> Tensor {
        uneven(0.7, &[24]) + 0.05 * uneven(1., &[2, count, 24])
    }

    #[test]
    fn views_make_the_same_memory_one_by_one() {
        let registers = alike(2).get(0).unsqueeze(0);
        let of_views = |views: i64| {
            let tokens = alike(5 * views);
            let view = |n| tokens.narrow(1, 5 * n, 5);
            let all = Tensor::cat(&[&registers.expand([2, -1, -1], false), &tokens], 1);
            (Memory::new(&all), Memory::of_views(&registers, views, view, Precision::F32))
        };
        let largest = |t: Tensor| t.abs().max().double_value(&[]);
        for views in [1, 3, 9] {
            let (at_once, one_by_one) = of_views(views);
            let whole = |memory: &Memory| &memory.tokens + &memory.common;
            assert!(largest(whole(&at_once) - whole(&one_by_one)) < 1e-6, "{views} views");
            // A twentieth of the tokens, as they are made, is their own.
            let [own, apart] = [&at_once, &one_by_one].map(|memory| largest(memory.tokens.shallow_clone()));
            assert!(apart < 1.5 * own && apart < 0.2 * largest(whole(&at_once)), "{own} {apart}");
        }
    }
}
