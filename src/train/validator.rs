//! How good the model has become: what a run validates it with.

use super::trainer::Trainer;
use crate::error::Result;
use crate::model::Stage;

/// Means over everything that is held out.
#[derive(Debug, Clone, PartialEq)]
pub struct Score {
    /// In dB, the mean over the scenes.
    pub psnr: f64,
    /// The mean over the scenes.
    pub ssim: f64,
    /// How many there are.
    pub scenes: usize,
    /// At which the model was judged: the one that it has been trained to.
    pub stage: Stage,
    /// What is wrong with those that can't be used, each told once.
    pub left_out: Vec<String>,
}

/// Judges a model by what training never shows.
pub trait Validator {
    /// How many scenes it looks at, by which ranks see that they look at the same.
    fn scenes(&self) -> usize;

    /// The score of the model as it is now; none where `go_on`, which is called now and then, says no.
    ///
    /// # Errors
    /// No scene that can be used, or whatever the model fails with.
    fn validate(&mut self, trainer: &Trainer, go_on: &mut dyn FnMut() -> bool) -> Result<Option<Score>>;
}
