//! Configuration of the coarse-to-fine curriculum: the number of Gaussians per scene token in the course of training.

use crate::error::{Error, Result};
use crate::model::{ModelConfig, Stage};
use serde::{Deserialize, Serialize};

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
