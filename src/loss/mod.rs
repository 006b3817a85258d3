//! Losses (spec 7.1): the terms and their weighted sum.

mod config;
mod perceptual;
mod perceptual_network;
mod terms;

pub use config::{LossConfig, PerceptualKind};
pub use perceptual_network::{PerceptualBackbone, PerceptualNetwork};
pub use terms::{
    DecoderRegularization, decoder_regularization, depth_smoothness, fill_masked, frustum, masked_mse,
    mean_weight, mse, photometric, psnr_of_mse, sh_soft_cap, ssim,
};

// Used by training, which may run the model in slices.
pub(crate) use terms::{StepFraction, consistency, depth_pixels};

use crate::data::Batch;
use crate::model::Decoded;
use crate::render::RenderOutput;
use std::ops::Index;
use tch::{Kind, Tensor, no_grad};

/// Declares [`Term`] from a list, so that each entry defines a term's name and index: sums, logs and TensorBoard iterate over [`Term::ALL`].
macro_rules! terms {
    ($($(#[$meta:meta])* $term:ident $name:literal)*) => {
        /// Term of the loss, or a part of a term that is logged separately.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Term {
            $($(#[$meta])* $term),*
        }

        impl Term {
            /// All terms, in the order in which they are summed and logged.
            pub const ALL: [Term; [$($name),*].len()] = [$(Term::$term),*];

            /// Returns the term's name in logs.
            pub fn name(self) -> &'static str {
                match self {
                    $(Term::$term => $name),*
                }
            }
        }
    };
}

terms! {
    /// Mean squared error of the rendered colors.
    Mse "mse"
    /// Perceptual loss, L_perc; 0 if it is left out.
    Perceptual "perceptual"
    /// Consistency of the two subsets, L_con, with its factors; 0 if the sample isn't paired.
    Consistency "consistency"
    /// Frustum constraint, L_fru.
    Frustum "frustum"
    /// Regularization of the decoder, L_dec: the sum of the following parts, with its own factor.
    Decoder "decoder"
    /// Opacity part of L_dec, L_opacity; 0 if it is left out.
    DecoderOpacity "decoder_opacity"
    /// Scale part of L_dec, L_scale.
    DecoderScale "decoder_scale"
    /// Rotation part of L_dec, L_rot.
    DecoderRotation "decoder_rotation"
    /// Spherical harmonics part of L_dec, L_SH.
    DecoderSh "decoder_sh"
}

impl Term {
    /// Returns the term's weight in the sum; `None` for a part of another term.
    pub fn factor(self, config: &LossConfig) -> Option<f64> {
        match self {
            Term::Mse => Some(config.mse),
            Term::Perceptual => Some(config.perceptual_factor),
            Term::Consistency => Some(1.),
            Term::Frustum => Some(config.frustum),
            Term::Decoder => Some(config.decoder),
            Term::DecoderOpacity | Term::DecoderScale | Term::DecoderRotation | Term::DecoderSh => None,
        }
    }
}

/// Total loss and its terms without their weights: scalar tensors, or numbers.
#[derive(Debug, Clone, Copy, Default)]
pub struct Losses<T> {
    /// Weighted sum of the terms, which is minimized.
    pub total: T,
    terms: [T; Term::ALL.len()],
}

impl Losses<Tensor> {
    /// Computes every term with `term`, and their sum weighted by `config`.
    pub fn weighted(config: &LossConfig, term: impl Fn(Term) -> Tensor) -> Self {
        let terms = Term::ALL.map(term);
        let counted = Term::ALL.iter().zip(&terms).filter_map(|(of, term)| Some(term * of.factor(config)?));
        let total = counted.reduce(|sum, term| sum + term).expect("terms that count");
        Losses { total, terms }
    }

    /// Packs the values into one float64 tensor, the total first and then the terms, so that they can be summed over slices of a step
    /// without losing precision and read in one transfer.
    pub fn packed(&self) -> Tensor {
        let all: Vec<&Tensor> = std::iter::once(&self.total).chain(&self.terms).collect();
        no_grad(|| Tensor::stack(&all, 0).to_kind(Kind::Double))
    }
}

impl Losses<f64> {
    /// Number of values in the tensor of [`Losses::packed`].
    pub const COUNT: usize = 1 + Term::ALL.len();

    /// Unpacks the values of [`Losses::packed`].
    pub fn unpacked(values: &[f64; Self::COUNT]) -> Self {
        Losses { total: values[0], terms: std::array::from_fn(|term| values[1 + term]) }
    }
}

impl<T> Index<Term> for Losses<T> {
    type Output = T;

    fn index(&self, term: Term) -> &T {
        &self.terms[term as usize]
    }
}

/// Computes the loss terms of `decoded`, which was rendered from the target cameras to `rendered`. All terms are means over equally
/// large halves, so for a paired sample the sum is ½(L_a + L_b) + L_con. The losses of all shares of a step add up to the step's loss.
pub(crate) fn losses(
    config: &LossConfig,
    perceptual: Option<&PerceptualNetwork>,
    batch: &Batch,
    decoded: &Decoded,
    rendered: &RenderOutput,
    share: &StepFraction,
) -> Losses<Tensor> {
    let ground_truth = &batch.target.images;
    let masks = batch.target_masks();
    let mse = match &masks {
        Some(masks) => mean_over_scenes(&rendered.rgb, &batch.unpaired(ground_truth), masks, masked_mse),
        None => mse(&rendered.rgb, ground_truth),
    } * share.scenes;
    let perceptual = match (perceptual, &masks) {
        (Some(network), Some(masks)) => {
            let loss = |image: &Tensor, ground_truth: &Tensor, mask: &Tensor| {
                network.loss(&fill_masked(image, ground_truth, mask), ground_truth) / mean_weight(mask)
            };
            mean_over_scenes(&rendered.rgb, &batch.unpaired(ground_truth), masks, loss) * share.scenes
        }
        (Some(network), None) => network.loss(&rendered.rgb, &batch.unpaired(ground_truth)) * share.scenes,
        (None, _) => mse.zeros_like(),
    };
    let consistency = match batch.paired {
        true => {
            let (alpha, depth) = (rendered.alpha.chunk(2, 0), rendered.depth.chunk(2, 0));
            let factors = (config.consistency_alpha, config.consistency_depth);
            consistency([&alpha[0], &alpha[1]], [&depth[0], &depth[1]], masks.as_ref(), factors, share)
        }
        false => mse.zeros_like(),
    };
    let frustum = frustum(&decoded.gaussians.means, &batch.context, &batch.far) * share.scenes;
    let decoder = decoder_regularization(&decoded.raw, config.decoder_opacity);
    Losses::weighted(config, |term| match term {
        Term::Mse => mse.shallow_clone(),
        Term::Perceptual => perceptual.shallow_clone(),
        Term::Consistency => consistency.shallow_clone(),
        Term::Frustum => frustum.shallow_clone(),
        Term::Decoder => &decoder.total * share.scenes,
        Term::DecoderOpacity => &decoder.opacity * share.scenes,
        Term::DecoderScale => &decoder.scale * share.scenes,
        Term::DecoderRotation => &decoder.rotation * share.scenes,
        Term::DecoderSh => &decoder.sh * share.scenes,
    })
}

/// Computes the mean of `loss` over the B scenes of `ground_truth` [B, C, 3, H, W] with `masks` [B, C, 1, H, W]. Each scene's mean is over its
/// own pixels that count, so that the slices of a step add up. `rendered` [R·B, C, 3, H, W] holds R renderings of the ground truth along the
/// batch.
fn mean_over_scenes(
    rendered: &Tensor,
    ground_truth: &Tensor,
    masks: &Tensor,
    loss: impl Fn(&Tensor, &Tensor, &Tensor) -> Tensor,
) -> Tensor {
    let (size, count) = (ground_truth.size(), ground_truth.size()[0]);
    let repeated = rendered.reshape([&[-1], size.as_slice()].concat());
    let of_scene = |scene: i64| {
        let [ground_truth, mask] = [ground_truth, masks].map(|t| t.narrow(0, scene, 1));
        loss(&repeated.select(1, scene), &ground_truth, &mask)
    };
    (0..count).map(of_scene).reduce(|sum, loss| sum + loss).expect("a scene") / count as f64
}
