//! Interface by which a run validates its model.

use super::trainer::Trainer;
use crate::error::Result;
use crate::model::Stage;

/// Mean scores over all held-out views or scenes.
#[derive(Debug, Clone, PartialEq)]
pub struct Score {
    /// Mean PSNR over the scenes, in dB.
    pub psnr: f64,
    /// Mean SSIM over the scenes.
    pub ssim: f64,
    /// Number of scenes.
    pub scenes: usize,
    /// Stage at which the model was evaluated: the one that it has been trained to.
    pub stage: Stage,
    /// Reasons why scenes were left out, each listed once.
    pub left_out: Vec<String>,
}

/// Evaluation of a model on data that training doesn't use.
pub trait Validator {
    /// Returns the number of scenes. Ranks compare it to check that they evaluate the same scenes.
    fn scenes(&self) -> usize;

    /// Returns the score of the model as it is now, or `None` if `should_continue`, which is called at intervals, returns `false`.
    ///
    /// # Errors
    /// Returns an error if no scene can be used, or if the evaluation fails.
    fn validate(
        &mut self,
        trainer: &Trainer,
        should_continue: &mut dyn FnMut() -> bool,
    ) -> Result<Option<Score>>;
}
