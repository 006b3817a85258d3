//! Report of a training step.

use crate::loss::{Losses, Term, psnr_of_mse};
use crate::model::Stage;
use tch::Tensor;

/// Report of a training step.
#[derive(Debug)]
pub struct StepReport {
    /// Step, counted from 0.
    pub step: u64,
    /// Curriculum stage.
    pub stage: Stage,
    /// Learning rate.
    pub learning_rate: f64,
    /// Loss and its terms.
    pub losses: Losses<f64>,
    /// Norm of the gradient, before clipping.
    pub gradient_norm: f64,
    /// `true` if loss or gradient wasn't finite, so that no weights were changed.
    pub skipped: bool,
    /// Names of the scenes of this rank, or of all ranks if the step was skipped.
    pub scenes: Vec<String>,
    /// Preview of the first scene before the step, `[3, H, W]`, at the steps that `train.log_images_every` selects.
    pub picture: Option<Tensor>,
    /// `true` if no rank was asked to stop.
    pub should_continue: bool,
}

impl StepReport {
    /// Returns the PSNR of all rendered images together, in dB.
    pub fn psnr(&self) -> f64 {
        psnr_of_mse(self.losses[Term::Mse])
    }
}
