//! Tests that a step of several ranks equals the step of a single one.

use super::step_tests::{config, far_from_the_start, scenes, small, trained};
use super::{StepReport, Trainer};
use crate::config::{Config, OptimizerKind, TrainConfig};
use crate::data::{Batch, LoadedScene, TrainingScenes};
use crate::device::{Stopwatch, num_threads};
use crate::loss::Term;
use crate::ranks::ProcessGroup;
use crate::ranks::tests::{can_meet, run_on_ranks};
use std::collections::BTreeMap;
use std::sync::Arc;
use tch::{Device, Tensor};

/// Number of scenes in a step of all ranks together.
const SCENES: usize = 6;
const STEPS: usize = 10;
/// Variable of the model that no step changes.
const NOT_TRAINED: &str = "gaussian_decoder.patch_center_bias";

fn training(train: TrainConfig) -> Config {
    // There is no warm-up, so that the learning rate is about the same in all steps.
    config(small(), TrainConfig { steps: 100, warmup: 0., learning_rate: 3e-5, ..train })
}

/// Trains a trainer for some steps on its rank's share of `scenes`, which `perturb` changes before each step. Returns the trainer and its
/// reports.
fn trained_on(
    config: &Config,
    group: ProcessGroup,
    perturb: impl Fn(usize, &mut [LoadedScene]),
) -> (Trainer, Vec<StepReport>) {
    let (rank, share) = (group.rank(), SCENES / group.world_size());
    let mut trainer = far_from_the_start(config).with_group(group);
    // L_perc takes most of the time. It is a mean over scenes like L_mse, so the tests don't need it.
    trainer.perceptual = None;
    let step = |step: usize| {
        let mut scenes = scenes(SCENES);
        perturb(step, &mut scenes);
        let sample = Batch::from_scenes(&scenes[rank * share..][..share], Device::Cpu).unwrap();
        trainer.train_step(&sample, &mut Stopwatch::default(), &mut || true).expect("a step")
    };
    let reports = (0..STEPS).map(step).collect();
    (trainer, reports)
}

/// Returns copies of the trained weights.
fn weights(trainer: &Trainer) -> BTreeMap<String, Tensor> {
    trained(trainer).into_iter().map(|(name, value)| (name, value.detach().copy())).collect()
}

/// Returns the distance of `a` from `b`, relative to the norm of `b`.
fn distance(a: &Tensor, b: &Tensor) -> f64 {
    ((a - b).norm() / b.norm()).double_value(&[])
}

/// Compares ranks that train with `config` to a trainer that does the same steps alone, with `alone`. Returns the reports of the latter.
fn assert_like_one(
    ranks: usize,
    config: &Config,
    alone: &Config,
    tolerance: f64,
    perturb: impl Fn(usize, &mut [LoadedScene]) + Copy + Sync,
) -> Vec<StepReport> {
    let _guard = num_threads::keep();
    let start = weights(&far_from_the_start(config));
    let (alone, expected) = trained_on(alone, ProcessGroup::single(), perturb);
    let alone = weights(&alone);
    let found = run_on_ranks(ranks, |group| {
        let (trainer, reports) = trained_on(config, group, perturb);
        (weights(&trainer), reports)
    });
    for (rank, (weights, reports)) in found.iter().enumerate() {
        for (name, value) in weights {
            assert!(*value == found[0].0[name], "rank {rank} has other bits than the first in {name}");
            // A key's bias adds the same value to all scores of a query, so its gradient is 0.
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

/// Several ranks make the step of one up to rounding, however the step is cut into slices. Adam amplifies gradients that are nothing but
/// rounding errors.
#[test]
fn ranks_make_the_step_of_one() {
    if !can_meet() {
        return;
    }
    let alone = training(TrainConfig::default());
    for (ranks, train) in [
        (2, TrainConfig::default()),
        (3, TrainConfig::default()),
        // Slices of one and two scenes, and then recomputed rounds.
        (2, TrainConfig { micro_batch: 2, ..Default::default() }),
        (3, TrainConfig { micro_batch: 1, checkpoint_rounds: true, ..Default::default() }),
    ] {
        assert_like_one(ranks, &training(train), &alone, 1e-5, |_, _| {});
    }
}

/// Ranks give the same step as the slices of a single rank that divide the scenes alike.
#[test]
fn ranks_make_the_slices_of_one() {
    if !can_meet() {
        return;
    }
    let with = |micro_batch| training(TrainConfig { micro_batch, ..Default::default() });
    // The sum of two values doesn't depend on their order.
    assert_like_one(2, &with(0), &with(3), 0., |_, _| {});
    assert_like_one(3, &with(0), &with(2), 1e-5, |_, _| {});
}

#[test]
fn a_nan_loss_on_one_rank_skips_the_step_on_all_ranks() {
    if !can_meet() {
        return;
    }
    let perturb = |step: usize, scenes: &mut [LoadedScene]| {
        if step == 3 {
            // A scene of the last rank.
            scenes[SCENES - 1].far = f64::NAN;
        }
    };
    let config = |micro_batch| training(TrainConfig { micro_batch, ..Default::default() });
    let reports = assert_like_one(2, &config(0), &config(3), 0., perturb);
    let skipped: Vec<bool> = reports.iter().map(|report| report.skipped).collect();
    assert!(skipped[3] && skipped.iter().filter(|skipped| **skipped).count() == 1, "{skipped:?}");
}

#[test]
fn a_skipped_step_reports_the_scenes_of_all_ranks() {
    if !can_meet() {
        return;
    }
    let config = training(TrainConfig::default());
    let found = run_on_ranks(2, |group| {
        let perturb = |step: usize, scenes: &mut [LoadedScene]| {
            if step == 0 {
                scenes[0].far = f64::NAN;
            }
        };
        trained_on(&config, group, perturb).1.into_iter().map(|report| report.scenes).collect::<Vec<_>>()
    });
    let names = |numbers: std::ops::Range<usize>| numbers.map(|i| format!("noise_{i}")).collect::<Vec<_>>();
    assert!(found.iter().all(|scenes| scenes[0] == names(0..6)), "{found:?}");
    assert_eq!((&found[0][1], &found[1][1]), (&names(0..3), &names(3..6)));
}

/// A sharded optimizer gives the same bits as an unsharded one. Each rank updates its share of the parameters, and all ranks get the
/// others' shares.
#[test]
fn a_sharded_optimizer_matches_an_unsharded_one() {
    if can_meet() {
        [OptimizerKind::AdamW, OptimizerKind::Muon].into_iter().for_each(sharding_changes_nothing);
    }
}

fn sharding_changes_nothing(optimizer: OptimizerKind) {
    let _guard = num_threads::keep();
    let config = training(TrainConfig { optimizer, ..Default::default() });
    let trained = |sharded: bool| {
        run_on_ranks(3, |group| {
            let rank = group.rank();
            let mut trainer = far_from_the_start(&config).with_group(group);
            if sharded {
                trainer = trainer.with_sharded_optimizer();
            }
            trainer.broadcast_state().expect("the first rank");
            for _ in 0..3 {
                let sample = Batch::from_scenes(&scenes(3)[rank..][..1], Device::Cpu).unwrap();
                trainer.train_step(&sample, &mut Stopwatch::default(), &mut || true).expect("a step");
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
    let found = run_on_ranks(3, |group| {
        let rank = group.rank();
        let mut trainer = far_from_the_start(&config).with_group(group);
        let sample = Batch::from_scenes(&scenes(3)[rank..][..1], Device::Cpu).unwrap();
        let step = |step: usize| {
            let asked = rank == 1 && step == 2;
            trainer
                .train_step(&sample, &mut Stopwatch::default(), &mut || !asked)
                .expect("a step")
                .should_continue
        };
        (0..4).map(step).collect::<Vec<_>>()
    });
    assert_eq!(found, vec![vec![true, true, false, true]; 3]);
}

/// All ranks take over the state of the first one: weights, moments, step and position in the data.
#[test]
fn ranks_follow_the_first() {
    if !can_meet() {
        return;
    }
    let config = training(TrainConfig::default());
    let found = run_on_ranks(2, |group| {
        let mut trainer = far_from_the_start(&config);
        if group.is_main_process() {
            let sample = Batch::from_scenes(&scenes(1), Device::Cpu).unwrap();
            trainer.train_step(&sample, &mut Stopwatch::default(), &mut || true).expect("a step");
            trainer.samples = 7;
            // Weights from elsewhere may have another value here.
            let _ = trainer.vs.variables()[NOT_TRAINED].shallow_clone().fill_(0.25);
        }
        let mut trainer = trainer.with_group(group);
        trainer.broadcast_state().expect("the first rank");
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
    // Returns the error of the second of two ranks.
    let refused = |second: fn(Config) -> Trainer| {
        let mut found = run_on_ranks(2, |group| {
            let config = training(TrainConfig::default());
            let trainer = if group.is_main_process() { far_from_the_start(&config) } else { second(config) };
            trainer.with_group(group).broadcast_state().map_err(|e| e.to_string())
        });
        found.remove(1).expect_err("the second rank goes on")
    };
    let other = refused(|mut config| {
        config.train.learning_rate = 0.5;
        // The locations of the data may differ.
        config.data.captures = vec!["elsewhere".into()];
        far_from_the_start(&config)
    });
    assert_eq!(
        other,
        "this rank's configuration differs from the first rank's: train.learning_rate 0.00003 → 0.5"
    );
    let scenes = refused(|config| {
        let scenes = TrainingScenes::find(&["synth:seed=1,scenes=3,size=32".into()]).expect("worlds");
        Trainer::new(&config, Arc::new(scenes), Device::Cpu).expect("a trainer")
    });
    assert!(scenes.starts_with("this rank's training scenes differ from the first rank's: 3 of"), "{scenes}");
}
