//! Schedule of the coarse-to-fine curriculum: the stage of each step (spec 8.7).

use crate::config::CurriculumConfig;
use crate::model::Stage;

/// Returns the stage of `step`, counted from 0. λ rises from 0 at a boundary to 1 `transition` steps later.
pub fn stage_at(config: &CurriculumConfig, step: u64) -> Stage {
    if config.full_capacity {
        return config.final_stage();
    }
    let boundaries = &config.boundaries[..config.boundaries.len().min(config.final_stage as usize)];
    let passed = boundaries.iter().take_while(|&&boundary| step >= boundary).count();
    match passed.checked_sub(1).map(|last| boundaries[last]) {
        Some(boundary) if step - boundary < config.transition => {
            Stage { index: passed as u32, mix: (step - boundary) as f64 / config.transition as f64 }
        }
        _ => Stage::complete(passed as u32),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_s_curriculum() {
        let config = CurriculumConfig::default();
        let at = |step| {
            let stage = stage_at(&config, step);
            (stage.index, stage.mix)
        };
        assert_eq!(at(0), (0, 1.));
        assert_eq!(at(9_999), (0, 1.));
        assert_eq!(at(10_000), (1, 0.));
        assert_eq!(at(11_000), (1, 0.5));
        assert_eq!(at(12_000), (1, 1.));
        assert_eq!(at(20_500), (2, 0.25));
        assert_eq!(at(50_000), (3, 0.));
        assert_eq!(at(219_999), (3, 1.));
    }

    #[test]
    fn boundaries_beyond_the_final_stage_are_ignored() {
        let config = CurriculumConfig { final_stage: 1, ..Default::default() };
        assert_eq!(stage_at(&config, 60_000), Stage::complete(1));
        let config = CurriculumConfig { final_stage: 0, ..Default::default() };
        assert_eq!(stage_at(&config, 60_000), Stage::complete(0));
    }

    #[test]
    fn full_capacity_starts_at_the_end() {
        let config = CurriculumConfig { full_capacity: true, ..Default::default() };
        assert_eq!(stage_at(&config, 0), Stage::complete(3));
    }
}
