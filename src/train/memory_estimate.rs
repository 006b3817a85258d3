//! How much memory a training step needs, told before it begins.

use crate::config::{Config, OptimizerKind};
use crate::error::Result;
use crate::loss::PerceptualLoss;
use crate::model::{GlobalSplat, ModelConfig, Precision, Streams};
use serde::Serialize;
use tch::{Device, nn};

/// What tensors of a training step take at the most, in bytes: counted by what each layer keeps for its gradient. Where a CPU computes
/// slices side by side, each but the first has gradients of its own beside that.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct MemoryEstimate {
    /// Scenes of a step.
    pub batch: usize,
    /// Those of them that go through the model at a time.
    pub scenes_at_once: usize,
    /// Weights and the optimizer's moments; and gradients, unless they take less than what layers kept before they came.
    pub weights: u64,
    /// Photos of all scenes.
    pub photos: u64,
    /// What tokenizer and encoder keep of the scenes that go through the model at a time.
    pub encoder: u64,
    /// The same of heads, Gaussians, pictures and losses; or part of it and a round that is computed again, if that is more.
    pub pictures: u64,
    /// What the network of L_perc keeps.
    pub perceptual: u64,
}

impl MemoryEstimate {
    /// Of a step of the curriculum's last stage, by one process on `device`.
    ///
    /// # Errors
    /// A model whose numbers don't fit together.
    pub fn of(config: &Config, device: Device) -> Result<Self> {
        Ok(Self::of_learned(config, learned_numbers(&config.model)?, device))
    }

    /// The same of a model that learns so many numbers.
    fn of_learned(config: &Config, learned: f64, device: Device) -> Self {
        const FLOAT: f64 = 4.;
        let (model, data) = (&config.model, &config.data);
        let (batch, precision) = (config.train.batch, config.train.precision);
        let scenes_at_once = match config.train.micro_batch {
            0 => batch,
            count => count.min(batch),
        };

        // Muon has one moment of a matrix, AdamW two of everything. Without slices or recomputation each gradient
        // replaces activations that are larger, so gradients add nothing to the peak.
        let moments = if config.train.optimizer == OptimizerKind::Muon { 1. } else { 2. };
        let gradients = if scenes_at_once < batch || config.train.checkpoint_rounds { 1. } else { 0. };

        // Scenes go through the model twice where halves of their views are compared, each time with half of the tokens.
        let passes = if config.loss.has_consistency() && data.context_views >= 2 { 2. } else { 1. };
        let pixels = f64::from(data.image_size.height) * f64::from(data.image_size.width);
        let (context, target) = (data.context_views as f64, data.target_views as f64);
        let tokens = context * pixels / (model.patch_size * model.patch_size) as f64;
        let [width, token_width] = [model.width, model.token_width()].map(|width| width as f64);
        let slots = passes * (model.latents + 9) as f64 * width;
        let streams = if model.streams == Streams::Dual { 2. } else { 1. };
        let (rounds, blocks) = (model.rounds as f64, model.self_attention_blocks as f64);

        // Numbers of a slot that the layers of a round keep, in units of the width. In bf16 norms, products, queries, keys, values,
        // what is seen and both sides of GELU are half as large; sums of a stream stay in float32.
        let (of_reading, of_block, of_mixer, small) = match precision {
            Precision::F32 => (18., 18., 10., 1.),
            Precision::Bf16 => (10.5, 10., 6., 0.5),
        };
        let of_round = slots * (streams * (of_reading + blocks * of_block) + (streams - 1.) * of_mixer)
            + tokens * streams * 2. * width * small;
        let (rounds_kept, computed_again) = match config.train.checkpoint_rounds {
            true => (rounds * slots * streams, of_round),
            false => (rounds * of_round, 0.),
        };
        let per_scene = slots * 3. * streams + tokens * (2. + 2.7) * token_width + rounds_kept;
        // Keys and values are read by weights that a norm's γ is folded into; bf16 has copies of all weights of products.
        let folded = rounds * streams * 2. * width * token_width
            + if precision == Precision::Bf16 { 0.5 * learned } else { 0. };

        let candidates = passes * (model.latents * model.candidates) as f64;
        let of_candidate = 10.3 * (14 + 3 * model.sh_bases()) as f64;
        let of_pixel = 11. + 3.;
        let pictures = candidates * of_candidate + passes * target * pixels * of_pixel;
        // Gaussians and pictures themselves, and their gradients, are still there when a round is computed again.
        let pictures = pictures.max(0.4 * pictures + computed_again);

        let bytes = |numbers: f64| (FLOAT * numbers) as u64;
        let at_once = scenes_at_once as f64;
        MemoryEstimate {
            batch,
            scenes_at_once,
            weights: bytes((1. + moments + gradients) * learned),
            photos: bytes(batch as f64 * (context + target) * 3. * pixels),
            encoder: bytes(at_once * per_scene + folded),
            pictures: bytes(at_once * pictures),
            perceptual: PerceptualLoss::bytes_kept(
                &config.loss,
                precision,
                data.image_size,
                scenes_at_once * data.target_views,
                device,
            ),
        }
    }

    /// All together.
    pub fn total(&self) -> u64 {
        self.weights + self.photos + self.encoder + self.pictures + self.perceptual
    }

    /// Whether a step fits into `bytes` of memory, with the 15 % by which the estimate may be too low.
    pub fn fits_into(&self, bytes: u64) -> bool {
        self.total() + self.total() * 3 / 20 <= bytes
    }
}

/// The batch of `config`, halved until all its scenes fit at once into `bytes` of memory on `device`, and the estimate of the last one that
/// did not, if any. A batch of 1 is tried in any case.
///
/// # Errors
/// As [`MemoryEstimate::of`].
pub fn batch_within(config: &Config, bytes: u64, device: Device) -> Result<(usize, Option<MemoryEstimate>)> {
    let mut config = config.clone();
    config.train.micro_batch = 0;
    let learned = learned_numbers(&config.model)?;
    let mut refused = None;
    while config.train.batch > 1 {
        let estimate = MemoryEstimate::of_learned(&config, learned, device);
        if estimate.fits_into(bytes) {
            break;
        }
        refused = Some(estimate);
        config.train.batch /= 2;
    }
    Ok((config.train.batch, refused))
}

/// How many numbers a model of `config` learns.
fn learned_numbers(config: &ModelConfig) -> Result<f64> {
    let mut vs = nn::VarStore::new(Device::Cpu);
    GlobalSplat::to_be_filled(&mut vs, config, Precision::F32)?;
    Ok(vs.trainable_variables().iter().map(|variable| variable.numel()).sum::<usize>() as f64)
}
