//! What a training step did.

use crate::loss::{Losses, Term, psnr_of_mse};
use crate::model::Stage;
use tch::Tensor;

/// What a step did.
#[derive(Debug)]
pub struct StepReport {
    /// Counted from 0.
    pub step: u64,
    /// Where the curriculum stood.
    pub stage: Stage,
    /// The learning rate used.
    pub learning_rate: f64,
    /// The loss and its terms.
    pub losses: Losses<f64>,
    /// Of the gradient, before clipping.
    pub gradient_norm: f64,
    /// Loss or gradient wasn't finite, so nothing was changed.
    pub skipped: bool,
    /// Names of the scenes that this rank looked at; of a skipped step, those of all ranks.
    pub scenes: Vec<String>,
    /// What the first of them looked like before the step, at the steps that `train.pictures_every` chooses, [3, H, W].
    pub picture: Option<Tensor>,
    /// Whether no rank was asked to stop.
    pub go_on: bool,
}

impl StepReport {
    /// Of all pictures together, in dB.
    pub fn psnr(&self) -> f64 {
        psnr_of_mse(self.losses[Term::Mse])
    }
}
