//! Conversion of a smaller model's weights to those of a larger model, from which training continues (spec 3.4 and 4.7).

use super::config::ModelConfig;
use super::decoder::{OPACITY, PARAMETERS};
use tch::{Kind, Tensor};

/// Standard deviation of the noise between the copies of a scene token, relative to that of all scene tokens.
const SPREAD: f64 = 0.2;

/// Differences by which one model is larger than another.
#[derive(Debug)]
pub(crate) struct Growth {
    /// Configuration of the smaller model.
    from: ModelConfig,
    /// Patch edge of the smaller model divided by that of the larger one.
    patch_size_ratio: i64,
    /// Number of scene tokens in the larger model for each one of the smaller model.
    latent_ratio: i64,
}

impl Growth {
    /// Returns the growth from `from` towards `to`, as far as there are rules for it. Other differences are ignored.
    pub fn from_configs(from: &ModelConfig, to: &ModelConfig) -> Self {
        let times = |whole: i64, part: i64| if whole % part == 0 { whole / part } else { 1 };
        Growth {
            patch_size_ratio: times(from.patch_size, to.patch_size),
            latent_ratio: times(to.latents, from.latents),
            from: from.clone(),
        }
    }

    /// Returns the configuration of the larger model.
    pub fn result(&self) -> ModelConfig {
        ModelConfig {
            patch_size: self.from.patch_size / self.patch_size_ratio,
            latents: self.from.latents * self.latent_ratio,
            ..self.from.clone()
        }
    }

    /// Converts `weights`, called `name` in the smaller model, to the larger model. Draws from libtorch's random generator.
    pub fn convert(&self, name: &str, weights: &Tensor) -> Tensor {
        match name {
            "ray_patch_embeds.1.weight" | "rgb_patch_embeds.1.weight" => {
                shrink_patch_weights(weights, self.from.patch_size, self.patch_size_ratio)
            }
            "scene_tokens" if self.latent_ratio > 1 => {
                let (m, d) = weights.size2().expect("[M, d]");
                repeat_scene_tokens(
                    weights,
                    &Tensor::randn([self.latent_ratio * m, d], (weights.kind(), weights.device())),
                )
            }
            "gaussian_decoder.geo_param_readout.bias" => split_opacity_bias(weights, self.latent_ratio),
            _ => weights.shallow_clone(),
        }
    }
}

/// Converts patch weights [d, p·p·C] for patches of `patch` × `patch` pixels to patches of 1 / `patch_size_ratio` the edge. The result
/// gives for a small patch what `weights` give for the same patch enlarged (spec 3.4).
pub(crate) fn shrink_patch_weights(weights: &Tensor, patch: i64, patch_size_ratio: i64) -> Tensor {
    let (d, edge) = (weights.size()[0], patch / patch_size_ratio);
    let pixels = weights.view([d, edge, patch_size_ratio, edge, patch_size_ratio, -1]);
    pixels.sum_dim_intlist([2i64, 4].as_slice(), false, None::<Kind>).view([d, -1])
}

/// Repeats each of the scene tokens [M, d] n times, and adds a little of the normal noise [n·M, d] (spec 4.7). The result is [n·M, d].
pub(crate) fn repeat_scene_tokens(tokens: &Tensor, noise: &Tensor) -> Tensor {
    let latent_ratio = noise.size()[0] / tokens.size()[0];
    tokens.repeat_interleave_self_int(latent_ratio, 0, None) + noise * (SPREAD * tokens.std(false))
}

/// Shifts the opacity logits in the parameter head's bias, [10·K], so that `latent_ratio` overlapping Gaussians, of which each was half
/// opaque, together cover half of what is behind them (spec 4.7).
pub(crate) fn split_opacity_bias(bias: &Tensor, latent_ratio: i64) -> Tensor {
    let shift = bias.zeros_like();
    let shared = ((1. / latent_ratio as f64).exp2() - 1.).ln();
    let _ = shift.view([-1, PARAMETERS]).select(1, OPACITY).fill_(shared);
    bias + shift
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::patchify;
    use tch::Device;

    #[test]
    fn smaller_patches_match_enlarged_patches() {
        let numbers = |size: &[i64], seed: f64| {
            let count = size.iter().product();
            (Tensor::linspace(0., seed, count, (Kind::Double, Device::Cpu)) * 1e3).sin().view(size)
        };
        for (patch, times) in [(8, 2), (12, 3), (4, 4), (6, 1)] {
            let weights = numbers(&[5, patch * patch * 3], 1.);
            let edge = patch / times;
            let small = numbers(&[1, 2, 2 * edge, 3 * edge, 3], 2.);
            let enlarged =
                small.repeat_interleave_self_int(times, 2, None).repeat_interleave_self_int(times, 3, None);
            let expected = patchify(&enlarged, patch).linear(&weights, None::<&Tensor>);
            let of_small = shrink_patch_weights(&weights, patch, times);
            let found = patchify(&small, edge).linear(&of_small, None::<&Tensor>);
            let error = ((&found - &expected).norm() / expected.norm()).double_value(&[]);
            assert!(found.size() == [1, 2, 6, 5] && error < 1e-9, "{patch}, {times}: {error:.1e}");
        }
    }

    #[test]
    fn repeated_tokens_differ_by_noise_and_keep_total_opacity() {
        tch::manual_seed(4);
        let of = |latents| ModelConfig { latents, ..Default::default() };
        for latent_ratio in [1, 2, 3] {
            let growth = Growth::from_configs(&of(500), &of(500 * latent_ratio));
            let tokens = Tensor::randn([500, 16], (Kind::Float, Device::Cpu)) * 3.;
            let apart =
                growth.convert("scene_tokens", &tokens).view([500, latent_ratio, 16]) - tokens.unsqueeze(1);
            let apart = apart.square().mean(None::<Kind>).sqrt().double_value(&[]);
            let expected = if latent_ratio == 1 { 0. } else { 3. * SPREAD };
            assert!((apart - expected).abs() < 0.05 * expected + 1e-9, "{latent_ratio} copies: {apart}");

            // Bias of two candidates that are half opaque.
            let bias = Tensor::zeros([2 * PARAMETERS], (Kind::Double, Device::Cpu));
            let grown =
                growth.convert("gaussian_decoder.geo_param_readout.bias", &bias).view([2, PARAMETERS]);
            let left = grown.select(1, OPACITY).sigmoid().neg() + 1.;
            let covered: Tensor = 1. - left.pow_tensor_scalar(latent_ratio);
            assert!(
                covered.allclose(&covered.full_like(0.5), 1e-12, 0., false),
                "{latent_ratio} copies: {covered:?}"
            );
            assert_eq!(grown.narrow(1, 0, OPACITY).abs().sum(None::<Kind>).double_value(&[]), 0.);
        }
    }

    #[test]
    fn unsupported_differences_are_ignored() {
        let from = ModelConfig { patch_size: 8, latents: 16, ..Default::default() };
        let to = |patch_size, latents| ModelConfig { patch_size, latents, ..from.clone() };
        for (wanted, reached) in [
            (to(8, 16), to(8, 16)),
            (to(4, 48), to(4, 48)),
            (to(3, 48), to(8, 48)),
            (to(2, 24), to(2, 16)),
            (to(16, 8), to(8, 16)),
        ] {
            assert_eq!(Growth::from_configs(&from, &wanted).result(), reached);
        }
    }
}
