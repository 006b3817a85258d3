//! What depends on the number of a step alone: its learning rate (spec 8.6), its stage of the curriculum (spec 8.7), and the subsets of
//! its context views that are compared (spec 7.8). And which weights decay, and which optimizer updates them (spec 8.5).

use crate::config::{CurriculumConfig, OptimizerKind, TrainConfig};
use crate::model::Stage;
use crate::optim::{ParameterGroup, UpdateRule};
use std::f64::consts::PI;
use tch::Tensor;
use tch::nn;

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

/// Suffix of the weights of self-attention's queries, keys and values, which are one layer.
const QKV: &str = ".qkv.weight";

/// Returns the trained variables of `vs` in groups. Weights of two or more dimensions decay; biases, norms, LayerScale and learned tokens
/// don't. If the optimizer is Muon, it updates the encoder's matrices, and AdamW updates all other variables (spec 8.5).
pub fn parameter_groups(vs: &nn::VarStore, config: &TrainConfig) -> Vec<ParameterGroup> {
    let trained = vs.variables().into_iter().filter(|(_, value)| value.requires_grad());
    let decays = |(name, value): &(String, Tensor)| name.ends_with(".weight") && value.dim() >= 2;
    let (decaying, others): (Vec<_>, Vec<_>) = trained.partition(decays);
    let is_muons = |name: &str| config.optimizer == OptimizerKind::Muon && name.starts_with("slot_encoder.");
    let (matrices, decaying): (Vec<_>, Vec<_>) = decaying.into_iter().partition(|(name, _)| is_muons(name));
    let (threefold, matrices): (Vec<_>, Vec<_>) =
        matrices.into_iter().partition(|(name, _)| name.ends_with(QKV));
    let group = |rule, parameters, weight_decay| ParameterGroup {
        rule,
        parameters,
        learning_rate: config.learning_rate,
        weight_decay,
    };
    vec![
        group(UpdateRule::AdamW, decaying, config.weight_decay),
        group(UpdateRule::AdamW, others, 0.),
        group(UpdateRule::Muon { parts: 1 }, matrices, config.weight_decay),
        group(UpdateRule::Muon { parts: 3 }, threefold, config.weight_decay),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{GlobalSplat, ModelConfig};
    use tch::Device;

    #[test]
    fn muon_updates_the_encoders_matrices_and_nothing_else() {
        let vs = nn::VarStore::new(Device::Cpu);
        let model = ModelConfig { rounds: 1, self_attention_blocks: 1, ..Default::default() };
        let _model = GlobalSplat::new(&vs.root(), &model).expect("a model");
        let of = |optimizer| parameter_groups(&vs, &TrainConfig { optimizer, ..Default::default() });
        let [adamw, muon] = [OptimizerKind::AdamW, OptimizerKind::Muon].map(of);
        let counts =
            |groups: &[ParameterGroup]| groups.iter().map(|g| g.parameters.len()).collect::<Vec<_>>();
        assert_eq!(counts(&adamw)[2..], [0, 0]);
        // Two layers before the rounds. Ten in the round of each stream, one of which computes queries, keys and values. Two in the mixer.
        assert_eq!(counts(&muon)[2..], [2 + 2 * 9 + 2, 2]);
        assert_eq!(counts(&muon).iter().sum::<usize>(), counts(&adamw).iter().sum::<usize>());
        for (group, parts) in muon[2..].iter().zip([1, 3]) {
            assert_eq!((group.rule, group.weight_decay), (UpdateRule::Muon { parts }, 1e-6));
            for (name, value) in &group.parameters {
                assert!(name.starts_with("slot_encoder.") && value.dim() == 2, "{name}");
                assert_eq!(value.size()[0] == 3 * value.size()[1], parts == 3, "{name}");
            }
        }
    }

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

    #[test]
    fn stages_begin_at_their_boundaries() {
        let paper = CurriculumConfig::default();
        // Boundaries beyond the final stage are ignored.
        let [first, second] = [0, 1].map(|final_stage| CurriculumConfig { final_stage, ..paper.clone() });
        let full = CurriculumConfig { full_capacity: true, ..paper.clone() };
        for (config, step, index, mix) in [
            (&paper, 0, 0, 1.),
            (&paper, 9_999, 0, 1.),
            (&paper, 10_000, 1, 0.),
            (&paper, 11_000, 1, 0.5),
            (&paper, 12_000, 1, 1.),
            (&paper, 20_500, 2, 0.25),
            (&paper, 50_000, 3, 0.),
            (&paper, 219_999, 3, 1.),
            (&first, 60_000, 0, 1.),
            (&second, 60_000, 1, 1.),
            (&full, 0, 3, 1.),
        ] {
            assert_eq!(stage_at(config, step), Stage { index, mix }, "step {step}");
        }
    }

    #[test]
    fn ends_are_shared_and_the_middle_alternates() {
        assert_eq!(subsets(7, 0), [vec![0, 1, 3, 5, 6], vec![0, 2, 4, 6, 6]]);
        assert_eq!(subsets(7, 1), [vec![0, 2, 4, 6, 6], vec![0, 1, 3, 5, 6]]);
        assert_eq!(subsets(2, 0), [vec![0, 1], vec![0, 1]]);
        assert_eq!(subsets(24, 0).map(|s| s.len()), [13, 13]);
    }
}
