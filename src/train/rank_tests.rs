//! Ranks that make a step together make the step of one.

use super::step_tests::{config, far_from_the_start, scenes, small, trained};
use super::{StepReport, Trainer};
use crate::config::{Config, OptimizerKind, TrainConfig};
use crate::data::{LoadedScene, Sample, TrainingScenes};
use crate::loss::Term;
use crate::optim::Stopwatch;
use crate::ranks::Group;
use crate::ranks::tests::{can_meet, together};
use std::collections::BTreeMap;
use std::sync::Arc;
use tch::{Device, Tensor};

/// Scenes of a step, all ranks together.
const SCENES: usize = 6;
const STEPS: usize = 10;
/// A variable of the model that no step changes.
const NOT_TRAINED: &str = "gaussian_decoder.patch_center_bias";

fn training(train: TrainConfig) -> Config {
    // Every step goes as far as any.
    config(small(), TrainConfig { steps: 100, warmup: 0., learning_rate: 3e-5, ..train })
}

/// A trainer that has done some steps on its group's share of `scenes`, whose `disturb`ed copies each step sees, and what it
/// told of them.
fn trained_on(
    config: &Config,
    group: Group,
    disturb: impl Fn(usize, &mut [LoadedScene]),
) -> (Trainer, Vec<StepReport>) {
    let (rank, share) = (group.rank(), SCENES / group.ranks());
    let mut trainer = far_from_the_start(config).with_ranks(group);
    // It takes most of the time, and is a mean over scenes as L_mse is.
    trainer.perceptual = None;
    let step = |step: usize| {
        let mut scenes = scenes(SCENES);
        disturb(step, &mut scenes);
        let sample = Sample::of(&scenes[rank * share..][..share], Device::Cpu);
        trainer.learn(&sample, &mut Stopwatch::default(), &mut || true).expect("a step")
    };
    let reports = (0..STEPS).map(step).collect();
    (trainer, reports)
}

/// Weights, copied.
fn weights(trainer: &Trainer) -> BTreeMap<String, Tensor> {
    trained(trainer).into_iter().map(|(name, value)| (name, value.detach().copy())).collect()
}

/// How far `a` is from `b`, as a share of `b`.
fn distance(a: &Tensor, b: &Tensor) -> f64 {
    ((a - b).norm() / b.norm()).double_value(&[])
}

/// Holds what ranks have become by `config` against a trainer that did the same alone, by `alone`, to `tolerance`.
fn assert_like_one(
    ranks: usize,
    config: &Config,
    alone: &Config,
    tolerance: f64,
    disturb: impl Fn(usize, &mut [LoadedScene]) + Copy + Sync,
) -> Vec<StepReport> {
    let start = weights(&far_from_the_start(config));
    let (alone, expected) = trained_on(alone, Group::alone(), disturb);
    let alone = weights(&alone);
    let found = together(ranks, |group| {
        let (trainer, reports) = trained_on(config, group, disturb);
        (weights(&trainer), reports)
    });
    for (rank, (weights, reports)) in found.iter().enumerate() {
        for (name, value) in weights {
            assert!(*value == found[0].0[name], "rank {rank} has other bits than the first in {name}");
            // A key's bias adds the same to all scores of a query: its gradient is 0.
            if name.ends_with("mem_k.bias") {
                assert!(*value == start[name], "{name} moved");
                continue;
            }
            let (off, moved) = (distance(value, &alone[name]), distance(value, &start[name]));
            assert!(
                off <= tolerance && moved > 1e-4,
                "{name} of {ranks} ranks is off by {off:.1e}, moved by {moved:.1e}"
            );
        }
        for (report, expected) in reports.iter().zip(&expected) {
            assert_eq!((report.step, report.skipped), (expected.step, expected.skipped));
            let numbers = |of: &StepReport| {
                Term::ALL
                    .map(|term| of.losses[term])
                    .into_iter()
                    .chain([of.losses.total, of.gradient_norm])
                    .collect::<Vec<_>>()
            };
            for (found, expected) in numbers(report).into_iter().zip(numbers(expected)) {
                let agree = (found.is_nan() && expected.is_nan())
                    || (found - expected).abs() <= 1e-4 * expected.abs();
                assert!(agree, "{found}, expected {expected}");
            }
        }
    }
    expected
}

/// However a step is cut into slices, the sums are the same up to their rounding; where a gradient is nothing but that, Adam makes
/// much of it.
#[test]
fn ranks_make_the_step_of_one() {
    if !can_meet() {
        return;
    }
    let alone = training(TrainConfig::default());
    for (ranks, train) in [
        (2, TrainConfig::default()),
        (3, TrainConfig::default()),
        // Slices of one and two scenes; and each round computed again.
        (2, TrainConfig { micro_batch: 2, ..Default::default() }),
        (3, TrainConfig { micro_batch: 1, checkpoint_rounds: true, ..Default::default() }),
    ] {
        assert_like_one(ranks, &training(train), &alone, 1e-5, |_, _| {});
    }
}

/// Slices of one rank are those of another way to share the same work out.
#[test]
fn ranks_make_the_slices_of_one() {
    if !can_meet() {
        return;
    }
    let with = |micro_batch| training(TrainConfig { micro_batch, ..Default::default() });
    // The sum of two numbers has no order.
    assert_like_one(2, &with(0), &with(3), 0., |_, _| {});
    assert_like_one(3, &with(0), &with(2), 1e-5, |_, _| {});
}

#[test]
fn a_loss_that_is_no_number_on_one_rank_skips_the_step_on_all() {
    if !can_meet() {
        return;
    }
    let disturb = |step: usize, scenes: &mut [LoadedScene]| {
        if step == 3 {
            // The last rank's.
            scenes[SCENES - 1].far = f64::NAN;
        }
    };
    let config = |micro_batch| training(TrainConfig { micro_batch, ..Default::default() });
    let reports = assert_like_one(2, &config(0), &config(3), 0., disturb);
    let skipped: Vec<bool> = reports.iter().map(|report| report.skipped).collect();
    assert!(skipped[3] && skipped.iter().filter(|skipped| **skipped).count() == 1, "{skipped:?}");
}

#[test]
fn of_a_skipped_step_all_ranks_know_all_scenes() {
    if !can_meet() {
        return;
    }
    let config = training(TrainConfig::default());
    let found = together(2, |group| {
        let disturb = |step: usize, scenes: &mut [LoadedScene]| {
            if step == 0 {
                scenes[0].far = f64::NAN;
            }
        };
        trained_on(&config, group, disturb).1.into_iter().map(|report| report.scenes).collect::<Vec<_>>()
    });
    let names = |numbers: std::ops::Range<usize>| numbers.map(|i| format!("noise_{i}")).collect::<Vec<_>>();
    assert!(found.iter().all(|scenes| scenes[0] == names(0..6)), "{found:?}");
    assert_eq!((&found[0][1], &found[1][1]), (&names(0..3), &names(3..6)));
}

/// Each rank updates its share of the parameters, and all have the others': bit by bit what they would have made by themselves.
#[test]
fn a_sharded_optimizer_is_the_whole_one() {
    if can_meet() {
        [OptimizerKind::AdamW, OptimizerKind::Muon].into_iter().for_each(sharding_changes_nothing);
    }
}

fn sharding_changes_nothing(optimizer: OptimizerKind) {
    let config = training(TrainConfig { optimizer, ..Default::default() });
    let trained = |sharded: bool| {
        together(3, |group| {
            let rank = group.rank();
            let mut trainer = far_from_the_start(&config).with_ranks(group);
            if sharded {
                trainer = trainer.with_sharded_optimizer();
            }
            trainer.follow_first().expect("the first rank");
            for _ in 0..3 {
                let sample = Sample::of(&scenes(3)[rank..][..1], Device::Cpu);
                trainer.learn(&sample, &mut Stopwatch::default(), &mut || true).expect("a step");
            }
            let moments: usize = trainer.optimizer.moments().map(Tensor::numel).sum();
            (weights(&trainer), trainer.optimizer_state().expect("all moments"), moments)
        })
    };
    let (whole, sharded) = (trained(false), trained(true));
    for (rank, ((found, _, own), (expected, _, all))) in sharded.iter().zip(&whole).enumerate() {
        assert!(expected.iter().all(|(name, value)| found[name] == *value), "weights of rank {rank}");
        assert!(3 * own < all + all / 10, "rank {rank} has {own} of {all} moments");
    }
    let ((_, found, _), (_, expected, _)) = (&sharded[0], &whole[0]);
    assert_eq!(found.len(), expected.len());
    assert!(expected.iter().all(|(name, moment)| found[name] == *moment), "what a checkpoint holds");
}

#[test]
fn ranks_stop_together() {
    if !can_meet() {
        return;
    }
    let config = training(TrainConfig::default());
    let found = together(3, |group| {
        let rank = group.rank();
        let mut trainer = far_from_the_start(&config).with_ranks(group);
        let sample = Sample::of(&scenes(3)[rank..][..1], Device::Cpu);
        let step = |step: usize| {
            let asked = rank == 1 && step == 2;
            trainer.learn(&sample, &mut Stopwatch::default(), &mut || !asked).expect("a step").go_on
        };
        (0..4).map(step).collect::<Vec<_>>()
    });
    assert_eq!(found, vec![vec![true, true, false, true]; 3]);
}

/// What one rank has learned, others take over: weights, moments, and where the run stands.
#[test]
fn ranks_follow_the_first() {
    if !can_meet() {
        return;
    }
    let config = training(TrainConfig::default());
    let found = together(2, |group| {
        let mut trainer = far_from_the_start(&config);
        if group.is_first() {
            let sample = Sample::of(&scenes(1), Device::Cpu);
            trainer.learn(&sample, &mut Stopwatch::default(), &mut || true).expect("a step");
            trainer.samples = 7;
            // Somebody else's weights may have it elsewhere.
            let _ = trainer.vs.variables()[NOT_TRAINED].shallow_clone().fill_(0.25);
        }
        let mut trainer = trainer.with_ranks(group);
        trainer.follow_first().expect("the first rank");
        let moments: Vec<Tensor> = trainer.optimizer.moments().map(Tensor::copy).collect();
        let variables: BTreeMap<_, _> =
            trainer.vs.variables().into_iter().map(|(name, value)| (name, value.detach().copy())).collect();
        (variables, moments, trainer.optimizer.steps(), trainer.step, trainer.samples)
    });
    let [first, second] = &found[..] else { panic!("two ranks") };
    assert!(first.0.iter().all(|(name, value)| *value == second.0[name]), "weights");
    assert_eq!(second.0[NOT_TRAINED].double_value(&[0, 0, 0]), 0.25);
    assert!(first.1.iter().zip(&second.1).all(|(a, b)| a == b), "moments");
    assert!(
        first.1.iter().any(|moment| moment.abs().max().double_value(&[]) > 0.),
        "moments that say something"
    );
    assert_eq!((second.2, second.3, second.4), (1, 1, 7));
}

#[test]
fn ranks_of_other_configurations_or_scenes_are_refused() {
    if !can_meet() {
        return;
    }
    // What the second of two ranks says.
    let refused = |second: fn(Config) -> Trainer| {
        let mut found = together(2, |group| {
            let config = training(TrainConfig::default());
            let trainer = if group.is_first() { far_from_the_start(&config) } else { second(config) };
            trainer.with_ranks(group).follow_first().map_err(|e| e.to_string())
        });
        found.remove(1).expect_err("the second rank goes on")
    };
    let other = refused(|mut config| {
        config.train.learning_rate = 0.5;
        // Where data lie may differ.
        config.data.captures = vec!["elsewhere".into()];
        far_from_the_start(&config)
    });
    assert_eq!(other, "this rank's configuration isn't the first one's: train.learning_rate 0.00003 → 0.5");
    let scenes = refused(|config| {
        let scenes = TrainingScenes::find(&["synth:seed=1,scenes=3,size=32".into()]).expect("worlds");
        Trainer::new(&config, Arc::new(scenes), Device::Cpu).expect("a trainer")
    });
    assert!(scenes.starts_with("this rank's training scenes aren't the first one's: 3 of"), "{scenes}");
}
