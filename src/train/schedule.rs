//! What depends on the number of a step alone: its learning rate (spec 8.6), its stage of the curriculum (spec 8.7), and the subsets of
//! its context views that are compared (spec 7.8).

use crate::config::{CurriculumConfig, TrainConfig};
use crate::model::Stage;
use std::f64::consts::PI;

/// Learning rate at the start of the warm-up, as a share of the peak.
const WARMUP_START: f64 = 1e-3;
/// Minimum of the learning rate at the end of the cosine, which is otherwise a fiftieth of the peak.
const MIN_LEARNING_RATE: f64 = 1e-6;

/// Returns the learning rate of `step`, counted from 0: linear warm-up from a thousandth of the peak, then a cosine.
pub fn learning_rate(config: &TrainConfig, step: u64) -> f64 {
    let peak = config.learning_rate;
    let warmup = (config.warmup * config.steps as f64).round();
    let step = step as f64;
    if step < warmup {
        return peak * (WARMUP_START + (1. - WARMUP_START) * step / warmup);
    }
    let floor = (peak / 50.).max(MIN_LEARNING_RATE).min(peak);
    let progress = ((step - warmup) / (config.steps as f64 - warmup).max(1.)).min(1.);
    floor + 0.5 * (peak - floor) * (1. + (PI * progress).cos())
}

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

/// Returns the positions of the two subsets of `views` ordered context views at `step`. Both have the first and the last view. Of the views
/// in between, odd positions go to the first subset and even ones to the second; on odd steps it is the other way round. The smaller
/// subset is padded with the last view. Needs at least two views.
pub fn subsets(views: usize, step: u64) -> [Vec<usize>; 2] {
    let last = views - 1;
    let subset = |parity: usize| {
        let middle = (1..last).filter(|position| position % 2 == parity);
        std::iter::once(0).chain(middle).chain([last]).collect::<Vec<_>>()
    };
    let (mut odd, mut even) = (subset(1), subset(0));
    let longer = odd.len().max(even.len());
    odd.resize(longer, last);
    even.resize(longer, last);
    if step.is_multiple_of(2) { [odd, even] } else { [even, odd] }
}
