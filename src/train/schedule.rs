//! Learning rate schedule (spec 8.6).

use crate::config::TrainConfig;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warm_up_peak_and_floor() {
        let config = TrainConfig::default(); // 220,000 steps, 6,600 of them warm-up
        let near = |step, expected: f64| {
            let lr = learning_rate(&config, step);
            assert!((lr / expected - 1.).abs() < 1e-9, "step {step}: {lr}");
        };
        near(0, 5e-7);
        near(3_300, 5e-4 * 0.5005);
        near(6_600, 5e-4);
        near((6_600 + 220_000) / 2, 0.5 * (5e-4 + 1e-5));
        near(220_000, 1e-5);
        near(300_000, 1e-5);
    }
}
