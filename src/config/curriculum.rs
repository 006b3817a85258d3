//! How many Gaussians a scene token shows, when.

use crate::error::{Error, Result};
use crate::model::{ModelConfig, Stage};
use serde::{Deserialize, Serialize};

/// The coarse-to-fine curriculum (spec 8.7).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CurriculumConfig {
    /// The stage that training ends in and inference uses: 2^s Gaussians per scene token.
    pub final_stage: u32,
    /// Steps at which stages 1, 2, … begin. Those beyond the final stage are ignored.
    pub boundaries: Vec<u64>,
    /// Steps over which λ goes from 0 to 1 after a boundary.
    pub transition: u64,
    /// The final stage from the first step: an ablation.
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
    /// The stage of inference.
    pub fn final_stage(&self) -> Stage {
        Stage::complete(self.final_stage)
    }
    /// Whether the numbers fit together, and `model`.
    ///
    /// # Errors
    /// Names the first field that doesn't.
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
