//! The network: posed images to Gaussians (spec 3 to 5, the paper's figure 2), with modules in the order of the data flow.
//!
//! Parameters have the names of the published weights. A model trained here and one published by the authors differ only in the file
//! format.

mod attention;
mod autograd;
mod camera_code;
mod config;
mod decoder;
mod denormals;
mod encoder;
mod flops;
mod growth;
mod layers;
mod memory;
mod merge;
mod mixer;
mod precision;
mod recompute;
mod rotation;
mod shapes;
mod stream;
mod tokens;

pub use config::{ModelConfig, Streams};
pub use decoder::{Decoded, RawOutputs};
pub use denormals::{are_denormals_flushed, flush_denormals};
pub use encoder::EncodedTokens;
pub use memory::Memory;
pub use merge::Stage;
pub use precision::Precision;
pub(crate) use precision::convolve;
pub use shapes::MODULES;

// Used by training, which runs the model in parts and grows smaller models into larger ones.
pub(crate) use autograd::{backward_from_grads, leaf, tracks_grad};
pub(crate) use growth::Growth;
pub(crate) use recompute::CheckpointedRounds;

// Used by the parity checks, which run every module by itself.
pub(crate) use attention::{attention, attention_libtorch};
pub(crate) use camera_code::CameraCode;
pub(crate) use decoder::{Decoder, MAX_SCALE};
pub(crate) use encoder::Encoder;
pub(crate) use growth::{repeat_scene_tokens, shrink_patch_weights, split_opacity_bias};
pub(crate) use merge::Candidates;
pub(crate) use mixer::Mixer;
pub(crate) use rotation::{quaternion_from_6d, rotation_matrix_from_6d};
pub(crate) use stream::{SelfAttentionBlock, StreamRound};
pub(crate) use tokens::{IMAGENET_MEAN, RayTokens, RgbTokens, Tokenizer, patchify};

use crate::error::Result;
use crate::scene::RadialWarp;
use layers::{ENCODER_STD, init_or_zeros, randn, without_random_init};
use std::collections::HashSet;
use tch::{Device, Kind, Tensor, nn};
use tracing::trace_span;

/// The complete model: tokenizer, encoder and decoder.
#[derive(Debug)]
pub struct GlobalSplat {
    config: ModelConfig,
    tokenizer: Tokenizer,
    scene_tokens: Tensor,
    encoder: Encoder,
    decoder: Decoder,
}

impl GlobalSplat {
    /// Builds the model with freshly initialized weights under `vs`.
    ///
    /// # Errors
    /// Returns an error if the fields of `config` don't fit together.
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

    /// Builds the model under the root of the empty `vs` for weights that are loaded from a file, with passes in `precision`. Weights that
    /// would be drawn at random are zero instead. Weights of the layers that compute in `precision` are stored in its kind, so that they
    /// aren't converted at every use.
    ///
    /// # Errors
    /// Returns an error if the fields of `config` don't fit together.
    pub fn uninitialized(vs: &mut nn::VarStore, config: &ModelConfig, precision: Precision) -> Result<Self> {
        // Creates every parameter in the kind of the products; the few others are converted to float32 below.
        vs.set_kind(precision.kind());
        let mut model = without_random_init(|| Self::new(&vs.root(), config))?;
        model.set_precision(precision);
        let layers = model.encoder.linear_layers().chain(model.decoder.linear_layers());
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

    /// Runs one forward pass. `images` [B, V, 3, H, W] in [0, 1], `c2w` [B, V, 4, 4] in the normalized scene, `intrinsics` [B, V, 3, 3] in
    /// pixels; H and W are multiples of the patch size.
    pub fn forward(&self, images: &Tensor, c2w: &Tensor, intrinsics: &Tensor, stage: Stage) -> Decoded {
        self.decode(&self.encode_memory(&self.memory(images, c2w, intrinsics, None)), stage)
    }

    /// Computes the image tokens, [B, V, P, ray width + RGB width]: the first part of [`GlobalSplat::forward`]. With a `warp`, the decoded
    /// Gaussians are those of the warped world, which [`RadialWarp::restore`] moves back.
    pub fn tokens(
        &self,
        images: &Tensor,
        c2w: &Tensor,
        intrinsics: &Tensor,
        warp: Option<&RadialWarp>,
    ) -> Tensor {
        trace_span!("tokens").in_scope(|| self.tokenizer.forward(images, c2w, intrinsics, warp))
    }

    /// Encodes image tokens into scene tokens that have attended to every view: the second part of [`GlobalSplat::forward`].
    pub fn encode(&self, tokens: &Tensor) -> EncodedTokens {
        self.encode_memory(&self.memory_of(tokens))
    }

    /// Computes the encoder's memory from image tokens [B, V, P, token width].
    fn memory_of(&self, tokens: &Tensor) -> Memory {
        self.encoder.memory(&tokens.flatten(1, 2))
    }

    /// Computes the encoder's memory from images and cameras. On a CPU without gradients it processes one view at a time, because the image
    /// tokens of many views are large. A GPU has enough memory for all views, and would spend the time on launching small kernels.
    pub fn memory(
        &self,
        images: &Tensor,
        c2w: &Tensor,
        intrinsics: &Tensor,
        warp: Option<&RadialWarp>,
    ) -> Memory {
        let tracks_grad = self.encoder.tracks_grad();
        if tracks_grad || images.device() != Device::Cpu {
            let memory = self.memory_of(&self.tokens(images, c2w, intrinsics, warp));
            // Converts once for all rounds. With gradients the memory stays in float32, in which they are accumulated.
            return if tracks_grad { memory } else { memory.to_kind(self.precision().kind()) };
        }
        let of_view = |view| {
            let [images, c2w, intrinsics] = [images, c2w, intrinsics].map(|t| t.narrow(1, view, 1));
            let warp = warp.map(|warp| warp.views(view, 1));
            self.tokens(&images, &c2w, &intrinsics, warp.as_ref()).squeeze_dim(1)
        };
        self.encoder.memory_of_views(images.size()[1], of_view)
    }

    /// Encodes the memory into scene tokens: [`GlobalSplat::encode`] without the computation of the memory.
    pub fn encode_memory(&self, memory: &Memory) -> EncodedTokens {
        self.encode_memory_with(memory, &|| ())
    }

    /// Runs [`GlobalSplat::encode_memory`] and calls `after_layers` after every few layers. All but a few weights are used exactly once, so
    /// the caller can release the memory of those that were used so far.
    pub fn encode_memory_with(&self, memory: &Memory, after_layers: &dyn Fn()) -> EncodedTokens {
        self.encoder.forward(&self.scene_tokens, memory, after_layers)
    }

    /// Runs [`GlobalSplat::encode`] with activation checkpointing: the backward pass recomputes every round.
    pub(crate) fn encode_checkpointed(&self, tokens: &Tensor) -> (EncodedTokens, CheckpointedRounds<'_>) {
        self.encoder.forward_checkpointed(&self.scene_tokens, self.memory_of(tokens))
    }

    /// Decodes scene tokens into the Gaussians of `stage`: the last part of [`GlobalSplat::forward`].
    pub fn decode(&self, encoded: &EncodedTokens, stage: Stage) -> Decoded {
        trace_span!("heads").in_scope(|| self.decoder.forward(encoded, stage))
    }

    /// Sets the precision of matrix products; the default is float32.
    pub fn set_precision(&mut self, precision: Precision) {
        self.encoder.precision = precision;
        self.decoder.precision = precision;
    }

    /// Precomputes everything that depends on weights alone, for weights that no longer change. A GPU then launches fewer kernels per pass,
    /// at the cost of more memory. Later changes to these weights have no effect.
    pub fn fold_weights(&mut self) {
        tch::no_grad(|| self.encoder.fold_weights());
    }

    /// Returns the precision of matrix products.
    pub fn precision(&self) -> Precision {
        self.encoder.precision
    }

    /// Returns the configuration that the model was built from.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }
}

/// Creates the learned scene tokens, [M, d]. They are initially orthogonal, as different from each other as possible, if there are at most
/// as many tokens as dimensions, and normally distributed otherwise.
pub(crate) fn scene_tokens(vs: &nn::Path, config: &ModelConfig) -> Tensor {
    let init = match config.latents <= config.width {
        true => init_or_zeros(nn::Init::Orthogonal { gain: ENCODER_STD }),
        false => randn(ENCODER_STD),
    };
    vs.var("scene_tokens", &[config.latents, config.width], init)
}

#[cfg(test)]
mod tests {
    use super::*;
    use globalsplat_csrc::ops::{computing, record_outermost_ops, without_own_linear_layers};
    use std::cell::Cell;

    /// A pass that releases the memory of weights after every few layers holds few weights at a time.
    #[test]
    fn encoding_reports_after_every_few_layers() {
        let config = ModelConfig {
            latents: 4,
            width: 16,
            heads: 2,
            rgb_width: 8,
            ray_width: 8,
            rounds: 3,
            self_attention_blocks: 2,
            ..Default::default()
        };
        let vs = nn::VarStore::new(Device::Cpu);
        let model = GlobalSplat::new(&vs.root(), &config).unwrap();
        let calls = Cell::new(0);
        tch::no_grad(|| {
            let tokens = Tensor::rand([1, 2, 5, config.token_width()], (Kind::Float, Device::Cpu));
            let memory = model.memory_of(&tokens);
            let encoded = model.encode_memory_with(&memory, &|| calls.set(calls.get() + 1));
            assert!(encoded.geometry.equal(&model.encode_memory(&memory).geometry));
        });
        // Queries, twice keys and values, their common part, outputs and the MLP, then three for each block.
        let of_stream = 6 + 3 * 2;
        // The projection of the slots, and in each round both streams and the mixer.
        assert_eq!(calls.get(), 1 + 3 * (2 * of_stream + 1));
    }

    /// A pass launches a bounded number of kernels, whatever the number of photos. On a GPU, a pass of the main model takes about as long
    /// as the host needs to launch its kernels.
    #[test]
    fn a_pass_takes_few_kernels() {
        // The layers of the main model, but narrow. In float64 and with an odd number of heads, the CPU takes the same code path as a GPU.
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
        // Rays are float32. There our own linear layers run in blocks on libtorch's threads, so they are counted separately.
        let of_tokens = |views: i64| {
            let options = (Kind::Float, Device::Cpu);
            let images = Tensor::rand([1, views, 3, 32, 32], options);
            let [c2w, intrinsics] = [4, 3].map(|n| Tensor::eye(n, options).expand([1, views, n, n], false));
            let (tokens, ops) = record_outermost_ops(|| model.tokens(&images, &c2w, &intrinsics, None));
            const LINEAR_LAYERS: usize = 2;
            (tokens.to_kind(Kind::Double), computing(&without_own_linear_layers(ops)) + LINEAR_LAYERS)
        };
        let (few, many) = (of_tokens(2), of_tokens(24));
        vs.double();
        model.fold_weights();
        let pass = |(tokens, of_tokens): (Tensor, usize)| {
            let (_, ops) = record_outermost_ops(|| {
                model.decode(&model.encode_memory(&model.memory_of(&tokens)), Stage::complete(2))
            });
            of_tokens + computing(&ops)
        };
        let kernels = pass(many);
        assert_eq!(pass(few), kernels, "whatever the number of photos");
        assert!((200..=450).contains(&kernels), "{kernels}");
    }
}
