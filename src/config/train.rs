//! Configuration of training: curriculum, optimizer, schedule, checkpoints and logs.

use crate::error::{Error, Result};
use crate::model::{ModelConfig, Precision, Stage};
use serde::{Deserialize, Serialize};

/// Optimizer of the encoder's matrices. AdamW updates all other weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OptimizerKind {
    /// AdamW, as in the paper.
    AdamW,
    /// Muon.
    Muon,
}

/// Optimizer, learning rate schedule, checkpoints and logs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Seed of the initial weights and of everything else that is drawn at random.
    pub seed: u64,
    /// Number of optimizer steps.
    pub steps: u64,
    /// Number of scenes in a step. With several processes, the number of scenes of each process.
    pub batch_size: usize,
    /// Number of scenes that go through the model at a time, or 0 for all scenes of a step at once. A smaller number needs less memory; the
    /// gradient is still that of the whole step. If `loss.consistency_depth` is used, a step in several slices takes one more forward pass:
    /// this term is a mean over pixels that are known only after rendering.
    pub micro_batch: usize,
    /// If `true`, the encoder keeps only the input of each round and recomputes the round in the backward pass (gradient checkpointing).
    /// Training needs less memory and a fifth more time.
    pub checkpoint_rounds: bool,
    /// Precision: `f32`, or `bf16` for the encoder's matrix products and the network of L_perc. `bf16` is faster for wide models on
    /// machines that have instructions for it.
    pub precision: Precision,
    /// Optimizer: `adamw` for all weights, or `muon` for the encoder's matrices and AdamW for all other weights.
    pub optimizer: OptimizerKind,
    /// Peak learning rate.
    pub learning_rate: f64,
    /// Share of the steps, from 0 to 1, over which the learning rate rises to its peak.
    pub warmup: f64,
    /// Decoupled weight decay of weights with two or more dimensions.
    pub weight_decay: f64,
    /// Maximum norm of the gradient. A gradient with a larger norm is scaled down to it.
    pub gradient_clip: f64,
    /// Number of steps between checkpoints.
    pub checkpoint_every: u64,
    /// Number of checkpoints to keep.
    pub keep_checkpoints: usize,
    /// Number of steps between validations, or 0 to validate only at the end.
    pub validate_every: u64,
    /// Maximum number of consecutive steps with a loss or gradient that isn't finite. Such steps are skipped; training fails when this many
    /// have been skipped in a row.
    pub max_nonfinite_steps: u64,
    /// Number of steps between scalars in the TensorBoard log. `metrics.jsonl` has the values of every step.
    pub log_every: u64,
    /// Number of steps between images in the TensorBoard log, or 0 for no images.
    pub log_images_every: u64,
}

impl Default for TrainConfig {
    fn default() -> Self {
        TrainConfig {
            seed: 0,
            steps: 220_000,
            batch_size: 16,
            micro_batch: 0,
            checkpoint_rounds: false,
            precision: Precision::F32,
            optimizer: OptimizerKind::AdamW,
            learning_rate: 5e-4,
            warmup: 0.03,
            weight_decay: 1e-6,
            gradient_clip: 1.,
            checkpoint_every: 1_000,
            keep_checkpoints: 2,
            validate_every: 5_000,
            max_nonfinite_steps: 20,
            log_every: 10,
            log_images_every: 1_000,
        }
    }
}

impl TrainConfig {
    /// Checks that the values are valid.
    ///
    /// # Errors
    /// Returns an error that names the first invalid field.
    pub(super) fn check(&self) -> Result<()> {
        for (field, value) in [
            ("train.batch_size", self.batch_size as u64),
            ("train.checkpoint_every", self.checkpoint_every),
            ("train.keep_checkpoints", self.keep_checkpoints as u64),
            ("train.max_nonfinite_steps", self.max_nonfinite_steps),
            ("train.log_every", self.log_every),
        ] {
            if value == 0 {
                return Err(Error::setting(field, 0, "1 or more"));
            }
        }
        for (field, value) in
            [("train.learning_rate", self.learning_rate), ("train.gradient_clip", self.gradient_clip)]
        {
            if !(value > 0. && value.is_finite()) {
                return Err(Error::setting(field, value, "a number above 0"));
            }
        }
        if !(self.weight_decay >= 0. && self.weight_decay.is_finite()) {
            return Err(Error::setting("train.weight_decay", self.weight_decay, "0 or more"));
        }
        if !(0. ..=1.).contains(&self.warmup) {
            return Err(Error::setting("train.warmup", self.warmup, "a fraction from 0 to 1"));
        }
        Ok(())
    }
}

/// Coarse-to-fine curriculum (spec 8.7).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CurriculumConfig {
    /// Stage in which training ends and that inference uses. In stage s, a scene token has 2^s Gaussians.
    pub final_stage: u32,
    /// Steps at which stages 1, 2, … begin, in ascending order. Entries beyond the final stage are ignored.
    pub boundaries: Vec<u64>,
    /// Number of steps after a boundary over which λ rises from 0 to 1.
    pub transition: u64,
    /// If `true`, training is in the final stage from the first step on (an ablation).
    pub full_capacity: bool,
}

impl Default for CurriculumConfig {
    fn default() -> Self {
        CurriculumConfig {
            final_stage: 3,
            boundaries: vec![10_000, 20_000, 50_000],
            transition: 2_000,
            full_capacity: false,
        }
    }
}

impl CurriculumConfig {
    /// Returns the stage that inference uses, complete.
    pub fn final_stage(&self) -> Stage {
        Stage::complete(self.final_stage)
    }

    /// Checks that the values are valid and fit `model`.
    ///
    /// # Errors
    /// Returns an error that names the first invalid field.
    pub(super) fn check(&self, model: &ModelConfig) -> Result<()> {
        let CurriculumConfig { final_stage, boundaries, full_capacity, .. } = self;
        if *final_stage > model.max_stage() {
            let expected = format!("{} at most: model.candidates is {}", model.max_stage(), model.candidates);
            return Err(Error::setting("curriculum.final_stage", final_stage, expected));
        }
        if !full_capacity && boundaries.len() < *final_stage as usize {
            let expected = format!("a step for each of the {final_stage} stages after the first");
            return Err(Error::setting("curriculum.boundaries", format!("{boundaries:?}"), expected));
        }
        if !boundaries.is_sorted() {
            return Err(Error::setting(
                "curriculum.boundaries",
                format!("{boundaries:?}"),
                "ascending steps",
            ));
        }
        Ok(())
    }
}
