//! The optimizer's numbers, and how a run keeps books.

use crate::error::{Error, Result};
use crate::model::Precision;
use serde::{Deserialize, Serialize};

/// What updates the encoder's matrices; all else is updated by AdamW.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OptimizerKind {
    /// AdamW, as the paper.
    AdamW,
    /// Muon.
    Muon,
}

/// Optimizer, schedule and bookkeeping.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Of initial weights and of everything drawn.
    pub seed: u64,
    /// Optimizer steps.
    pub steps: u64,
    /// Scenes in a step.
    pub batch: usize,
    /// Scenes that go through the model at a time, for less memory; the gradient is that of the whole step. 0 for all at
    /// once. With `loss.consistency_depth`, whose mean is over pixels that only pictures tell, it takes a forward pass more.
    pub micro_batch: usize,
    /// Whether the encoder keeps nothing of a round but what it began with, and computes the round again in the backward
    /// pass: less memory, a fifth more time.
    pub checkpoint_rounds: bool,
    /// `f32`, or `bf16` for the encoder's matrix products and the network of L_perc, which is faster for wide models where the
    /// machine has instructions for it.
    pub precision: Precision,
    /// `adamw`, or `muon` for the encoder's matrices.
    pub optimizer: OptimizerKind,
    /// Peak learning rate.
    pub learning_rate: f64,
    /// Share of the steps over which the learning rate rises.
    pub warmup: f64,
    /// Of weights with two or more dimensions.
    pub weight_decay: f64,
    /// Largest norm of the gradient.
    pub gradient_clip: f64,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Checkpoints kept.
    pub keep_checkpoints: usize,
    /// Steps between validations; 0 for one at the end alone.
    pub validate_every: u64,
    /// Steps in a row that may be skipped, because their loss or gradient isn't finite, before training fails.
    pub max_skipped: u64,
    /// Steps between numbers for TensorBoard; `metrics.jsonl` has those of every step.
    pub log_every: u64,
    /// Steps between pictures for TensorBoard; 0 for none.
    pub pictures_every: u64,
}

impl Default for TrainConfig {
    fn default() -> Self {
        TrainConfig {
            seed: 0,
            steps: 220_000,
            batch: 16,
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
            max_skipped: 20,
            log_every: 10,
            pictures_every: 1_000,
        }
    }
}

impl TrainConfig {
    /// # Errors
    /// Names the first field that can't be.
    pub(super) fn check(&self) -> Result<()> {
        for (field, value) in [
            ("train.batch", self.batch as u64),
            ("train.checkpoint_every", self.checkpoint_every),
            ("train.keep_checkpoints", self.keep_checkpoints as u64),
            ("train.max_skipped", self.max_skipped),
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
            return Err(Error::setting("train.warmup", self.warmup, "a share from 0 to 1"));
        }
        Ok(())
    }
}
