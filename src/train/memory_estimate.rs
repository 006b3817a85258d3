//! Estimate of the memory that a training step needs, computed before training starts.

use crate::config::{Config, OptimizerKind};
use crate::error::Result;
use crate::loss::PerceptualNetwork;
use crate::model::{GlobalSplat, Precision, Streams};
use serde::Serialize;
use tch::{Device, nn};

/// Estimated peak memory of the tensors in a training step, in bytes. It is computed from what each layer stores for the backward pass.
/// If a CPU computes slices in parallel, each slice but the first needs memory for gradients of its own in addition.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct MemoryEstimate {
    /// Number of scenes in a step.
    pub batch: usize,
    /// Number of scenes that go through the model at a time.
    pub scenes_at_once: usize,
    /// Weights and the optimizer's moments. Gradients are included unless they take less than the activations that they replace.
    pub weights: u64,
    /// Photos of all scenes.
    pub photos: u64,
    /// Activations of tokenizer and encoder, for the scenes that go through the model at a time.
    pub encoder: u64,
    /// Activations of heads, Gaussians, rendered images and losses, for the scenes that go through the model at a time; or part of them and
    /// a recomputed round, if that is more.
    pub pictures: u64,
    /// Activations of the network of L_perc.
    pub perceptual: u64,
}

impl MemoryEstimate {
    /// Estimates the memory of a step in the curriculum's last stage, by one process on `device`.
    ///
    /// # Errors
    /// Returns an error if the model's settings don't fit together.
    pub fn new(config: &Config, device: Device) -> Result<Self> {
        const FLOAT: f64 = 4.;
        let mut vs = nn::VarStore::new(Device::Cpu);
        GlobalSplat::uninitialized(&mut vs, &config.model, Precision::F32)?;
        let learned = vs.trainable_variables().iter().map(|variable| variable.numel()).sum::<usize>() as f64;
        let (model, data) = (&config.model, &config.data);
        let (batch, precision) = (config.train.batch_size, config.train.precision);
        let scenes_at_once = match config.train.micro_batch {
            0 => batch,
            count => count.min(batch),
        };

        // Muon has one moment per matrix, AdamW has two for all weights. Without slices or recomputation, each gradient replaces larger
        // activations, so gradients add nothing to the peak.
        let moments = if config.train.optimizer == OptimizerKind::Muon { 1. } else { 2. };
        let gradients = if scenes_at_once < batch || config.train.checkpoint_rounds { 1. } else { 0. };

        // If two halves of the context views are compared, scenes go through the model twice, each time with half of the tokens.
        let passes = if config.loss.has_consistency() && data.context_views >= 2 { 2. } else { 1. };
        let pixels = f64::from(data.image_size.height) * f64::from(data.image_size.width);
        let (context, target) = (data.context_views as f64, data.target_views as f64);
        let tokens = context * pixels / (model.patch_size * model.patch_size) as f64;
        let [width, token_width] = [model.width, model.token_width()].map(|width| width as f64);
        let slots = passes * (model.latents + 9) as f64 * width;
        let streams = if model.streams == Streams::Dual { 2. } else { 1. };
        let (rounds, blocks) = (model.rounds as f64, model.self_attention_blocks as f64);

        // Elements per slot that the layers of a round store, in units of the width. In bf16, norms, products, queries, keys, values,
        // attention outputs and both sides of GELU take half of the memory; the sums of a residual stream stay in float32.
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
        // The γ of a norm is folded into copies of the weights of keys and values. bf16 has copies of the weights of all matrix products.
        let folded = rounds * streams * 2. * width * token_width
            + if precision == Precision::Bf16 { 0.5 * learned } else { 0. };

        let candidates = passes * (model.latents * model.candidates) as f64;
        let of_candidate = 10.3 * (14 + 3 * model.sh_bases()) as f64;
        let of_pixel = 11. + 3.;
        let pictures = candidates * of_candidate + passes * target * pixels * of_pixel;
        // Gaussians and rendered images, and their gradients, are still in memory when a round is recomputed.
        let pictures = pictures.max(0.4 * pictures + computed_again);

        let bytes = |numbers: f64| (FLOAT * numbers) as u64;
        let at_once = scenes_at_once as f64;
        Ok(MemoryEstimate {
            batch,
            scenes_at_once,
            weights: bytes((1. + moments + gradients) * learned),
            photos: bytes(batch as f64 * (context + target) * 3. * pixels),
            encoder: bytes(at_once * per_scene + folded),
            pictures: bytes(at_once * pictures),
            perceptual: PerceptualNetwork::max_memory_bytes(
                &config.loss,
                precision,
                data.image_size,
                scenes_at_once * data.target_views,
                device,
            ),
        })
    }

    /// Returns the sum of all items.
    pub fn total(&self) -> u64 {
        self.weights + self.photos + self.encoder + self.pictures + self.perceptual
    }

    /// Returns `true` if a step fits into `bytes` of memory, with a margin of 15 % by which the estimate may be too low.
    pub fn fits_into(&self, bytes: u64) -> bool {
        self.total() + self.total() * 3 / 20 <= bytes
    }
}
