//! The network: posed images to Gaussians (spec 3 to 5, the paper's figure 2), with modules in the order of the data flow.
//!
//! Parameters have the names of the published weights. A model trained here and one published by the authors differ only in the file
//! format.

mod config;
mod decoder;
mod encoder;
mod layers;
mod precision;
mod tokens;

pub use config::{MODULES, ModelConfig, Streams};
pub use decoder::{Decoded, RawOutputs, Stage};
pub use encoder::EncodedTokens;
pub use precision::Precision;
pub(crate) use precision::convolve;
pub use tokens::ImageTokens;

// Used by training, which runs the model in parts and grows smaller models into larger ones.
pub(crate) use config::Growth;
pub(crate) use encoder::CheckpointedRounds;

// Used by the parity checks, which run parts of the model by themselves.
pub(crate) use decoder::{Decoder, MAX_SCALE, quaternion_from_6d};
pub(crate) use encoder::Encoder;
pub(crate) use layers::attention;
pub(crate) use tokens::{IMAGENET_MEAN, Tokenizer};

use crate::error::Result;
use crate::scene::RadialWarp;
use layers::{ENCODER_STD, init_or_zeros, randn, without_random_init};
use std::collections::HashSet;
use tch::{Device, Kind, Tensor, nn};
use tracing::trace_span;

/// Posed images of B scenes, V views each, as the model sees them.
#[derive(Debug)]
pub struct ModelInput {
    /// Images in [0, 1], [B, V, 3, H, W]. H and W are multiples of the patch size.
    pub images: Tensor,
    /// Poses, camera-to-world, in the normalized scene, [B, V, 4, 4].
    pub c2w: Tensor,
    /// Intrinsics in pixels, [B, V, 3, 3].
    pub intrinsics: Tensor,
    /// Inverse depth of each pixel along the camera's axis in units of the normalized scene, and its confidence from 0 to 1,
    /// [B, V, 2, H, W], for a model that was trained with `data.depths`.
    pub depths: Option<Tensor>,
}

impl ModelInput {
    /// Returns the warp that the depths determine (spec 3.5), in which the model sees the scene; `None` without depths.
    pub fn radial_warp(&self) -> Option<RadialWarp> {
        self.depths.as_ref().map(|depths| RadialWarp::new(&self.c2w, &self.intrinsics, depths))
    }

    /// Returns one view of every scene, without depths.
    fn view(&self, view: i64) -> Self {
        let [images, c2w, intrinsics] =
            [&self.images, &self.c2w, &self.intrinsics].map(|t| t.narrow(1, view, 1));
        ModelInput { images, c2w, intrinsics, depths: None }
    }
}

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

    /// Runs one forward pass, which consists of [`GlobalSplat::tokens`], [`GlobalSplat::encode`] and [`GlobalSplat::decode`], and returns
    /// the Gaussians in the normalized scene.
    pub fn forward(&self, input: &ModelInput, stage: Stage) -> Decoded {
        let warp = input.radial_warp();
        let encoded = self.encode(&self.tokens(input, warp.as_ref()));
        self.decode(&encoded, warp.as_ref(), stage)
    }

    /// Computes the image tokens of the scene that `warp` warps, if there is one. On a CPU without gradients it processes one view at a
    /// time, because the tokens of many views are large. A GPU has enough memory for all views, and would spend the time on launching small
    /// kernels.
    pub fn tokens(&self, input: &ModelInput, warp: Option<&RadialWarp>) -> ImageTokens {
        let tracks_grad = self.encoder.tracks_grad();
        if tracks_grad || input.images.device() != Device::Cpu {
            let tokens = self.tokens_at_once(input, warp);
            // Converts once for all rounds. With gradients the tokens stay in float32, in which they are accumulated.
            return if tracks_grad { tokens } else { tokens.to_kind(self.precision().kind()) };
        }
        self.encoder.image_tokens_of_views(input.images.size()[1], |view| {
            let warp = warp.map(|warp| warp.views(view, 1));
            self.raw_tokens(&input.view(view), warp.as_ref()).squeeze_dim(1)
        })
    }

    fn tokens_at_once(&self, input: &ModelInput, warp: Option<&RadialWarp>) -> ImageTokens {
        self.encoder.image_tokens(&self.raw_tokens(input, warp).flatten(1, 2))
    }

    /// Computes the image tokens before their normalization, [B, V, P, ray width + RGB width].
    fn raw_tokens(&self, input: &ModelInput, warp: Option<&RadialWarp>) -> Tensor {
        trace_span!("tokens").in_scope(|| self.tokenizer.forward(input, warp))
    }

    /// Encodes image tokens into scene tokens that have attended to every view.
    pub fn encode(&self, tokens: &ImageTokens) -> EncodedTokens {
        self.encoder.forward(&self.scene_tokens, tokens)
    }

    /// Runs [`GlobalSplat::encode`] with activation checkpointing for `tokens` that collect gradients ([`ImageTokens::leaf`]): the backward
    /// pass recomputes every round.
    pub(crate) fn encode_checkpointed<'a>(
        &'a self,
        tokens: &'a ImageTokens,
    ) -> (EncodedTokens, CheckpointedRounds<'a>) {
        self.encoder.forward_checkpointed(&self.scene_tokens, tokens)
    }

    /// Decodes scene tokens into the Gaussians of `stage`, and moves them from the scene that `warp` warps back to the normalized one.
    pub fn decode(&self, encoded: &EncodedTokens, warp: Option<&RadialWarp>, stage: Stage) -> Decoded {
        trace_span!("heads").in_scope(|| self.decoder.forward(encoded, stage)).unwarp(warp)
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

// A backward pass in several parts: the forward pass is cut at detached tensors that collect the gradients.

/// Returns a detached copy of `output` that requires a gradient: the input of the next part, where that part's backward pass ends.
pub(crate) fn leaf(output: &Tensor) -> Tensor {
    output.detach().set_requires_grad(true)
}

/// Returns `true` if gradients will flow back to `t` from what is computed from it now. `t.requires_grad()` is not enough: a leaf, and a
/// view of one, report their own flag even where gradients are disabled.
pub(crate) fn tracks_grad(t: &Tensor) -> bool {
    t.sum(Kind::Float).requires_grad()
}

/// Continues the backward pass from the `outputs` of a part, each paired with the detached copy that holds its gradient.
///
/// tch can't start a backward pass with given gradients. The sum of the products of outputs and gradients has exactly these gradients.
pub(crate) fn backward_from_grads<'a>(outputs: impl IntoIterator<Item = (&'a Tensor, &'a Tensor)>) {
    let products = outputs.into_iter().filter_map(|(output, leaf)| {
        let gradient = leaf.grad();
        gradient.defined().then(|| (output * gradient).sum(Kind::Float))
    });
    if let Some(objective) = products.reduce(|a, b| a + b) {
        objective.backward();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use globalsplat_csrc::runtime::{computing, record_ops};

    fn narrow() -> ModelConfig {
        ModelConfig {
            latents: 16,
            width: 24,
            heads: 3,
            rgb_width: 16,
            ray_width: 8,
            candidates: 4,
            ..Default::default()
        }
    }

    /// Returns `views` random images of 32×32 pixels from one camera.
    fn input(views: i64) -> ModelInput {
        let options = (Kind::Float, Device::Cpu);
        let images = Tensor::rand([1, views, 3, 32, 32], options);
        let c2w = Tensor::eye(4, options).expand([1, views, 4, 4], false);
        let intrinsics = Tensor::from_slice(&[32f32, 0., 16., 0., 32., 16., 0., 0., 1.]).view([3, 3]);
        ModelInput { images, c2w, intrinsics: intrinsics.expand([1, views, 3, 3], false), depths: None }
    }

    /// Depths reach the network through [`GlobalSplat::forward`], and its Gaussians are those of the normalized scene.
    #[test]
    fn a_forward_pass_with_depths_sees_and_restores_the_warped_scene() {
        let vs = nn::VarStore::new(Device::Cpu);
        let model = GlobalSplat::new(&vs.root(), &narrow()).unwrap();
        let (plain, stage) = (input(2), Stage::complete(2));
        let depth = |inverse: f64| Tensor::full([1, 2, 32, 32], inverse, (Kind::Float, Device::Cpu));
        let depths = Some(Tensor::stack(&[depth(0.2), depth(1.)], 2));
        let [images, c2w, intrinsics] =
            [&plain.images, &plain.c2w, &plain.intrinsics].map(Tensor::shallow_clone);
        let deep = ModelInput { images, c2w, intrinsics, depths };
        let warp = deep.radial_warp().expect("depths");
        let scene_tokens = model.encode(&model.tokens(&deep, Some(&warp)));
        let expected = warp.restore(&model.decode(&scene_tokens, None, stage).gaussians);
        let found = model.forward(&deep, stage).gaussians;
        assert!(found.means.equal(&expected.means) && found.scales.equal(&expected.scales));
        assert!(!found.means.allclose(&model.forward(&plain, stage).gaussians.means, 0.1, 0.1, false));
        // One view after the other, as without gradients.
        let one_by_one = tch::no_grad(|| model.forward(&deep, stage)).gaussians;
        assert!(one_by_one.means.allclose(&expected.means, 1e-4, 1e-4, false));
    }

    /// A pass launches a bounded number of kernels, whatever the number of photos. On a GPU, a pass of the main model takes about as long
    /// as the host needs to launch its kernels.
    #[test]
    fn a_pass_takes_few_kernels() {
        // The layers of the main model, but narrow. In float64 and with an odd number of heads, the CPU takes the same code path as a GPU.
        let config = narrow();
        assert_eq!((config.rounds, config.self_attention_blocks), (4, 2), "the main model's");
        let mut vs = nn::VarStore::new(Device::Cpu);
        let mut model = GlobalSplat::new(&vs.root(), &config).unwrap();
        vs.freeze();
        // Rays are float32. There our own linear layers run in blocks on libtorch's threads, so they are counted separately.
        let of_tokens = |views: i64| {
            let (tokens, mut ops) = record_ops(|| model.tokens_at_once(&input(views), None));
            const LINEAR_LAYERS: usize = 2;
            let of_blocks = ["aten::copy_", "aten::linear", "mkldnn::_linear_pointwise"];
            ops.retain(|op| !of_blocks.contains(&op.name.as_str()));
            (tokens, computing(&ops) + LINEAR_LAYERS)
        };
        let (few, many) = (of_tokens(2), of_tokens(24));
        vs.double();
        model.fold_weights();
        let pass = |(tokens, of_tokens): (ImageTokens, usize)| {
            let [centered, mean] = [tokens.centered, tokens.mean].map(|t| t.to_kind(Kind::Double));
            let tokens = ImageTokens { centered, mean };
            let (_, ops) = record_ops(|| model.decode(&model.encode(&tokens), None, Stage::complete(2)));
            of_tokens + computing(&ops)
        };
        let kernels = pass(many);
        assert_eq!(pass(few), kernels, "whatever the number of photos");
        assert!((200..=450).contains(&kernels), "{kernels}");
    }
}
