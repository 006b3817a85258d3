//! The configuration of the model: its inference from the shapes of weights, and the growth of a smaller model into a larger one.

use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use tch::{Kind, Tensor};

/// Number of outputs per candidate of the parameter head: 3 log-scales, 6 rotation values, 1 opacity logit.
pub(super) const PARAMETERS: i64 = 10;
/// Index of the opacity logit among these outputs.
pub(super) const OPACITY: i64 = 9;

/// Number of streams of scene tokens.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Streams {
    /// Separate geometry and appearance streams, joined by a mixer after every round: the full model.
    Dual,
    /// One stream without a mixer: an ablation.
    Single,
}

/// Architecture parameters of spec 3 to 5. The default is the main 16K model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// Edge of a patch in pixels, p.
    pub patch_size: i64,
    /// Number of scene tokens, M.
    pub latents: i64,
    /// Width of a scene token, d.
    pub width: i64,
    /// Width of the RGB half of an image token.
    pub rgb_width: i64,
    /// Width of the ray half of an image token.
    pub ray_width: i64,
    /// Number of encoder rounds.
    pub rounds: i64,
    /// Number of self-attention blocks in each stream and round.
    pub self_attention_blocks: i64,
    /// Number of attention heads.
    pub heads: i64,
    /// Number of candidate Gaussians per scene token, K: a power of two.
    pub candidates: i64,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: i64,
    /// Number of streams: dual, or the single-stream ablation.
    pub streams: Streams,
    /// Adds the camera code to ray tokens if `true`; `false` is the "Plücker only" ablation.
    pub camera_code: bool,
}

impl Default for ModelConfig {
    fn default() -> Self {
        ModelConfig {
            patch_size: 8,
            latents: 2048,
            width: 512,
            rgb_width: 512,
            ray_width: 256,
            rounds: 4,
            self_attention_blocks: 2,
            heads: 8,
            candidates: 16,
            sh_degree: 3,
            streams: Streams::Dual,
            camera_code: true,
        }
    }
}

impl ModelConfig {
    /// Returns the number of spherical harmonics per color channel.
    pub fn sh_bases(&self) -> i64 {
        (self.sh_degree + 1).pow(2)
    }

    /// Returns the width of an image token.
    pub fn token_width(&self) -> i64 {
        self.ray_width + self.rgb_width
    }

    /// Returns the last stage that the number of candidates allows: log2 K.
    pub fn max_stage(&self) -> u32 {
        self.candidates.ilog2()
    }

    /// Checks that the fields are in range and fit together.
    ///
    /// # Errors
    /// Names the first field that is invalid.
    pub fn check(&self) -> Result<()> {
        // The upper bounds are far beyond any model; they keep products of the fields from overflowing.
        let fields = [
            ("patch_size", self.patch_size, 1..=1 << 10),
            ("latents", self.latents, 1..=1 << 20),
            ("width", self.width, 1..=1 << 16),
            ("rgb_width", self.rgb_width, 1..=1 << 16),
            ("ray_width", self.ray_width, 1..=1 << 16),
            ("rounds", self.rounds, 0..=1 << 10),
            ("self_attention_blocks", self.self_attention_blocks, 0..=1 << 10),
            ("heads", self.heads, 1..=1 << 16),
            ("candidates", self.candidates, 1..=1 << 10),
            ("sh_degree", self.sh_degree, 0..=3),
        ];
        for (name, value, range) in fields {
            if !range.contains(&value) {
                let (least, most) = (range.start(), range.end());
                return Err(Error::setting(format!("model.{name}"), value, format!("{least} to {most}")));
            }
        }
        if self.width % self.heads != 0 {
            let expected = format!("a multiple of the {} heads", self.heads);
            return Err(Error::setting("model.width", self.width, expected));
        }
        if !(self.candidates as u64).is_power_of_two() {
            return Err(Error::setting("model.candidates", self.candidates, "a power of two"));
        }
        Ok(())
    }

    /// Returns a lower bound on the number of parameter values of this model: a file with fewer can't hold its weights.
    pub fn least_parameters(&self) -> i64 {
        let attention = self.rounds * (1 + self.self_attention_blocks) * self.width * self.width;
        let patches = 3 * self.patch_size * self.patch_size * self.rgb_width + self.ray_width;
        self.latents * self.width + attention + patches + self.candidates * self.width
    }

    /// Checks that images of this size can be cut into patches.
    ///
    /// # Errors
    /// Names the side that isn't a positive multiple of the patch size.
    pub fn check_image(&self, height: i64, width: i64) -> Result<()> {
        for (name, size) in [("height", height), ("width", width)] {
            if size <= 0 || size % self.patch_size != 0 {
                let p = self.patch_size;
                return Err(Error::request(format!(
                    "the image {name} is {size}, expected a multiple of the patch size {p}"
                )));
            }
        }
        Ok(())
    }
}

/// First components, up to the first dot, of all parameter names.
pub const MODULES: [&str; 6] =
    ["scene_tokens", "rgb_patch_embeds", "ray_patch_embeds", "view_pe", "slot_encoder", "gaussian_decoder"];

impl ModelConfig {
    /// Returns the configuration of the model whose parameters, by their published names, have these shapes. The number of heads can't be
    /// inferred from shapes and keeps its default.
    ///
    /// # Errors
    /// Returns an error if a required parameter is missing or has a shape that no model has. `origin` is the file named in the error.
    pub fn from_shapes(shapes: &BTreeMap<String, Vec<i64>>, origin: &Path) -> Result<Self> {
        let refuse = |name: &str, found: String, expected: &str| {
            Error::input(origin, format!("tensor {name}"), found, expected)
        };
        let matrix = |name: &str| match shapes.get(name).map(Vec::as_slice) {
            Some(&[rows, columns]) if rows > 0 && columns > 0 => Ok([rows, columns]),
            Some(other) => Err(refuse(name, format!("{other:?}"), "a matrix")),
            None => Err(refuse(name, "missing".into(), "one of a GlobalSplat model's weights")),
        };
        let count = |name: &dyn Fn(usize) -> String| {
            (0..).take_while(|&i| shapes.contains_key(&name(i))).count() as i64
        };
        let [latents, width] = matrix("scene_tokens")?;
        let (rgb, sh) = ("rgb_patch_embeds.1.weight", "gaussian_decoder.sh_readout.weight");
        let [rgb_width, inputs] = matrix(rgb)?;
        let [ray_width, _] = matrix("ray_patch_embeds.1.weight")?;
        let patch_size = (inputs / 3).isqrt();
        if 3 * patch_size * patch_size != inputs {
            return Err(refuse(
                rgb,
                format!("{:?}", [rgb_width, inputs]),
                "3 p² columns, of patches of p×p pixels",
            ));
        }
        let [candidates, _] = matrix("gaussian_decoder.gate_readout.weight")?;
        let [numbers, columns] = matrix(sh)?;
        let bases = numbers / 3 / candidates;
        let sh_degree = bases.isqrt() - 1;
        if 3 * candidates * (sh_degree + 1) * (sh_degree + 1) != numbers {
            let expected = format!("3 (l + 1)² rows of each of {candidates} candidates, of SH degree l");
            return Err(refuse(sh, format!("{:?}", [numbers, columns]), &expected));
        }
        let config = ModelConfig {
            patch_size,
            latents,
            width,
            rgb_width,
            ray_width,
            rounds: count(&|i| format!("slot_encoder.geo_rounds.{i}.lat_q.weight")),
            self_attention_blocks: count(&|i| format!("slot_encoder.geo_rounds.0.tower.{i}.norm1.weight")),
            candidates,
            sh_degree,
            streams: match shapes.contains_key("slot_encoder.slot_to_tex.1.weight") {
                true => Streams::Dual,
                false => Streams::Single,
            },
            camera_code: shapes.contains_key("view_pe.proj.weight"),
            ..Default::default()
        };
        Ok(config)
    }
}

/// Standard deviation of the noise between the copies of a scene token, relative to that of all scene tokens.
const TOKEN_NOISE: f64 = 0.2;

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
    tokens.repeat_interleave_self_int(latent_ratio, 0, None) + noise * (TOKEN_NOISE * tokens.std(false))
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
    use crate::model::tokens::patchify;
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
            let expected = if latent_ratio == 1 { 0. } else { 3. * TOKEN_NOISE };
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
