//! The network: posed images to Gaussians (spec 3 to 5, the paper's figure 2), in the order data flows.
//!
//! Parameters carry the names of the published weights, so that a model trained here and one published by the authors
//! are the same file after a change of container.

mod attention;
mod camera_code;
mod config;
mod decoder;
mod denormals;
mod encoder;
mod growth;
mod layers;
mod leaves;
mod memory;
mod merge;
mod mixer;
mod parts;
mod precision;
mod recompute;
mod rotation;
mod shapes;
mod stream;
mod tokens;

pub use config::{ModelConfig, Streams};
pub use decoder::{Decoded, RawOutputs};
pub use denormals::{are_denormals_flushed, flush_denormals};
pub use encoder::Encoded;
pub use memory::Memory;
pub use merge::Stage;
pub(crate) use parts::part;
pub use parts::{Event, told};
pub use precision::Precision;
pub(crate) use precision::convolve;
pub use shapes::MODULES;

// For training, which goes through the model in parts and from smaller models to larger ones.
pub(crate) use growth::Growth;
pub(crate) use leaves::{is_followed, leaf, pull_back};
pub(crate) use recompute::KeptRounds;

// For the parity checks, which run every module by itself.
pub(crate) use attention::{attention, by_libtorch};
pub(crate) use camera_code::CameraCode;
pub(crate) use decoder::{Decoder, MAX_SCALE};
pub(crate) use encoder::Encoder;
pub(crate) use growth::{for_smaller_patches, more_tokens, shared_opacities};
pub(crate) use merge::Candidates;
pub(crate) use mixer::Mixer;
pub(crate) use rotation::{quaternion_from_6d, rotation_matrix_from_6d};
pub(crate) use stream::{SelfAttentionBlock, StreamRound};
pub(crate) use tokens::{RayTokens, RgbTokens, Tokenizer, patchify};

use crate::error::Result;
use layers::{ENCODER_STD, drawn, randn, without_drawing};
use std::collections::HashSet;
use tch::{Device, Kind, Tensor, nn};

/// The whole model.
#[derive(Debug)]
pub struct GlobalSplat {
    config: ModelConfig,
    tokenizer: Tokenizer,
    scene_tokens: Tensor,
    encoder: Encoder,
    decoder: Decoder,
}

impl GlobalSplat {
    /// Builds the model with fresh weights under `vs`.
    ///
    /// # Errors
    /// A configuration whose numbers don't fit together.
    pub fn new(vs: &nn::Path, config: &ModelConfig) -> Result<Self> {
        config.check()?;
        Ok(GlobalSplat {
            tokenizer: Tokenizer::new(vs, config),
            scene_tokens: scene_tokens(vs, config),
            encoder: Encoder::new(&(vs / "slot_encoder"), config),
            decoder: Decoder::new(&(vs / "gaussian_decoder"), config),
            config: config.clone(),
        })
    }

    /// The same under the root of `vs`, which is empty, for weights from a file and passes in `precision`: with zeros where weights
    /// begin with random numbers, and weights of products in the kind that these take, so that nobody converts them at every use.
    ///
    /// # Errors
    /// As [`GlobalSplat::new`].
    pub fn to_be_filled(vs: &mut nn::VarStore, config: &ModelConfig, precision: Precision) -> Result<Self> {
        // All else is converted, as it is little.
        vs.set_kind(precision.kind());
        let mut model = without_drawing(|| Self::new(&vs.root(), config))?;
        model.set_precision(precision);
        let layers = model.encoder.products().chain(model.decoder.products());
        let kept: HashSet<_> = layers
            .flat_map(|layer| std::iter::once(&layer.ws).chain(&layer.bs))
            .map(Tensor::data_ptr)
            .collect();
        for mut variable in
            vs.variables().into_values().filter(|variable| !kept.contains(&variable.data_ptr()))
        {
            variable.set_data(&variable.to_kind(Kind::Float));
        }
        Ok(model)
    }

    /// One pass. `images` [B, V, 3, H, W] in [0, 1], `c2w` [B, V, 4, 4] in the normalized scene, `intrinsics`
    /// [B, V, 3, 3] in pixels; H and W multiples of the patch size.
    pub fn forward(&self, images: &Tensor, c2w: &Tensor, intrinsics: &Tensor, stage: Stage) -> Decoded {
        self.decode(&self.encode_memory(&self.memory(images, c2w, intrinsics)), stage)
    }

    /// The first third of [`GlobalSplat::forward`]: [B, V, P, ray width + RGB width].
    pub fn tokens(&self, images: &Tensor, c2w: &Tensor, intrinsics: &Tensor) -> Tensor {
        part("tokens", || self.tokenizer.forward(images, c2w, intrinsics))
    }

    /// The second third: scene tokens that have seen every view.
    pub fn encode(&self, tokens: &Tensor) -> Encoded {
        self.encode_memory(&self.memory_of(tokens))
    }

    /// What the encoder reads of image tokens [B, V, P, token width].
    fn memory_of(&self, tokens: &Tensor) -> Memory {
        self.encoder.memory(&tokens.flatten(1, 2))
    }

    /// The first third and the beginning of the second. On a CPU, where nobody asks for gradients, it goes view by view: image tokens of
    /// many views are large. A GPU has the memory, and would spend the time on launching small kernels.
    pub fn memory(&self, images: &Tensor, c2w: &Tensor, intrinsics: &Tensor) -> Memory {
        let is_followed = self.encoder.is_followed();
        if is_followed || images.device() != Device::Cpu {
            let memory = self.memory_of(&self.tokens(images, c2w, intrinsics));
            // Once for all rounds; gradients are added up in float32.
            return if is_followed { memory } else { memory.to_kind(self.precision().kind()) };
        }
        let of_view = |view| {
            let [images, c2w, intrinsics] = [images, c2w, intrinsics].map(|t| t.narrow(1, view, 1));
            self.tokens(&images, &c2w, &intrinsics).squeeze_dim(1)
        };
        self.encoder.memory_of_views(images.size()[1], of_view)
    }

    /// The rest of the second third.
    pub fn encode_memory(&self, memory: &Memory) -> Encoded {
        self.encoder.forward(&self.scene_tokens, memory)
    }

    /// As [`GlobalSplat::encode`], but every round is computed again in the backward pass.
    pub(crate) fn encode_keeping_rounds(&self, tokens: &Tensor) -> (Encoded, KeptRounds<'_>) {
        self.encoder.forward_keeping_rounds(&self.scene_tokens, self.memory_of(tokens))
    }

    /// The last third.
    pub fn decode(&self, encoded: &Encoded, stage: Stage) -> Decoded {
        part("heads", || self.decoder.forward(encoded, stage))
    }

    /// What matrix products are computed in from now on; float32 at first.
    pub fn set_precision(&mut self, precision: Precision) {
        self.encoder.precision = precision;
        self.decoder.precision = precision;
    }

    /// Computes once, from weights that don't change any more, what every pass would compute of them: fewer kernels for a GPU to launch,
    /// for more memory. Afterwards weights that are changed or learned have no effect on that.
    pub fn fold_weights(&mut self) {
        tch::no_grad(|| self.encoder.fold_weights());
    }

    /// What matrix products are computed in.
    pub fn precision(&self) -> Precision {
        self.encoder.precision
    }

    /// What the model was built from.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }
}

/// The learned scene tokens, [M, d]. Orthogonal ones start as different from each other as they can be; that needs no more
/// of them than dimensions.
pub(crate) fn scene_tokens(vs: &nn::Path, config: &ModelConfig) -> Tensor {
    let init = match config.latents <= config.width {
        true => drawn(nn::Init::Orthogonal { gain: ENCODER_STD }),
        false => randn(ENCODER_STD),
    };
    vs.var("scene_tokens", &[config.latents, config.width], init)
}

#[cfg(test)]
mod tests {
    use super::*;
    use globalsplat_csrc::ops::{computing, outermost_ops_of, without_own_linear_layers};

    /// A GPU computes a pass of the main model about as fast as the host tells it what to do.
    #[test]
    fn a_pass_takes_few_kernels() {
        // The main model's layers, narrow. In float64 and with an odd number of heads, the CPU takes the same code path
        // as a GPU.
        let config = ModelConfig {
            latents: 16,
            width: 24,
            heads: 3,
            rgb_width: 16,
            ray_width: 8,
            candidates: 4,
            ..Default::default()
        };
        assert_eq!((config.rounds, config.self_attention_blocks), (4, 2), "the main model's");
        let mut vs = nn::VarStore::new(Device::Cpu);
        let mut model = GlobalSplat::new(&vs.root(), &config).unwrap();
        vs.freeze();
        // Rays are in float32, where linear layers are our own, in blocks, on any of libtorch's threads: they are counted apart.
        let of_tokens = |views: i64| {
            let options = (Kind::Float, Device::Cpu);
            let images = Tensor::rand([1, views, 3, 32, 32], options);
            let [c2w, intrinsics] = [4, 3].map(|n| Tensor::eye(n, options).expand([1, views, n, n], false));
            let (tokens, ops) = outermost_ops_of(|| model.tokens(&images, &c2w, &intrinsics));
            const LINEAR_LAYERS: usize = 2;
            (tokens.to_kind(Kind::Double), computing(&without_own_linear_layers(ops)) + LINEAR_LAYERS)
        };
        let (few, many) = (of_tokens(2), of_tokens(24));
        vs.double();
        model.fold_weights();
        let pass = |(tokens, of_tokens): (Tensor, usize)| {
            let (_, ops) = outermost_ops_of(|| {
                model.decode(&model.encode_memory(&model.memory_of(&tokens)), Stage::complete(2))
            });
            of_tokens + computing(&ops)
        };
        let kernels = pass(many);
        assert_eq!(pass(few), kernels, "whatever the number of photos");
        assert!((200..=450).contains(&kernels), "{kernels}");
    }
}
