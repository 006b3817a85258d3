//! The network: posed images to Gaussians (spec 3 to 5, the paper's figure 2), in the order data flows.
//!
//! Parameters carry the names of the published weights, so that a model trained here and one published by the authors
//! are the same file after a change of container.

mod attention;
mod camera_code;
mod config;
mod decoder;
mod encoder;
mod layers;
mod leaves;
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
pub use encoder::Encoded;
pub use merge::Stage;
pub use parts::{Event, told};
pub use precision::Precision;
pub use shapes::MODULES;

// For training, which goes through the model in parts.
pub(crate) use leaves::{leaf, pull_back};
pub(crate) use recompute::KeptRounds;

// For the parity checks, which run every module by itself.
pub(crate) use attention::{attention, by_libtorch};
pub(crate) use camera_code::CameraCode;
pub(crate) use decoder::{Decoder, MAX_SCALE};
pub(crate) use encoder::Encoder;
pub(crate) use merge::Candidates;
pub(crate) use mixer::Mixer;
pub(crate) use rotation::{quaternion_from_6d, rotation_matrix_from_6d};
pub(crate) use stream::{SelfAttentionBlock, StreamRound, normalized};
pub(crate) use tokens::{RayTokens, RgbTokens, Tokenizer, patchify};

use crate::error::Result;
use layers::{ENCODER_STD, drawn, randn, without_drawing};
use parts::part;
use tch::{Tensor, nn};

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

    /// The same with zeros where weights begin with random numbers: for weights from a file, which are there sooner so.
    ///
    /// # Errors
    /// As [`GlobalSplat::new`].
    pub fn to_be_filled(vs: &nn::Path, config: &ModelConfig) -> Result<Self> {
        without_drawing(|| Self::new(vs, config))
    }

    /// One pass. `images` [B, V, 3, H, W] in [0, 1], `c2w` [B, V, 4, 4] in the normalized scene, `intrinsics`
    /// [B, V, 3, 3] in pixels; H and W multiples of the patch size.
    pub fn forward(&self, images: &Tensor, c2w: &Tensor, intrinsics: &Tensor, stage: Stage) -> Decoded {
        let encoded = self.encode(self.tokens(images, c2w, intrinsics));
        self.decode(&encoded, stage)
    }

    /// The first third of [`GlobalSplat::forward`]: [B, V, P, ray width + RGB width].
    pub fn tokens(&self, images: &Tensor, c2w: &Tensor, intrinsics: &Tensor) -> Tensor {
        part("tokens", || self.tokenizer.forward(images, c2w, intrinsics))
    }

    /// The second third: scene tokens that have seen every view. Of many, image tokens are large: nobody holds them any longer.
    pub fn encode(&self, tokens: Tensor) -> Encoded {
        let of_all_views = tokens.flatten(1, 2);
        drop(tokens);
        self.encoder.forward(&self.scene_tokens, of_all_views)
    }

    /// As [`GlobalSplat::encode`], but every round is computed again in the backward pass.
    pub(crate) fn encode_keeping_rounds(&self, tokens: &Tensor) -> (Encoded, KeptRounds<'_>) {
        self.encoder.forward_keeping_rounds(&self.scene_tokens, tokens.flatten(1, 2))
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
