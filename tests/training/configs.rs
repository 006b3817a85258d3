//! Every configuration in `configs/` and the embedded model.

use crate::common::room::write_room;
use globalsplat::config::Config;
use globalsplat::data::TrainingScenes;
use globalsplat::io::read_weights;
use globalsplat::loss::Term;
use globalsplat::model::Streams;
use globalsplat::reconstruct::{BUNDLED_MODEL, bundled_model};
use globalsplat::train::{MemoryEstimate, Trainer};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tch::{Device, Kind};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("configs")
}

fn read(name: &str) -> Config {
    Config::read(&folder().join(name).with_extension("toml"), &[]).expect("a configuration")
}

#[test]
fn every_configuration_builds_a_model_whose_steps_fit_into_a_large_gpu() {
    for entry in std::fs::read_dir(folder()).expect("configs/") {
        let path = entry.expect("an entry").path();
        let config = Config::read(&path, &[]).unwrap_or_else(|e| panic!("{e}"));
        // Round trip through TOML.
        let again = Config::parse(&config.to_toml(), &[], &path).expect("a configuration");
        assert_eq!(again, config, "{}", path.display());
        let bytes = MemoryEstimate::new(&config, Device::Cuda(0)).expect("a model").total();
        // A GPU has 80 GB. The rest is a margin for memory that the estimate doesn't include.
        assert!(bytes < 60_000_000_000, "{}: {:.1} GB", path.display(), bytes as f64 * 1e-9);
    }
}

#[test]
fn bundled_weights_match_the_configuration_tiny() {
    let shipped = bundled_model(Device::Cpu).expect("a model");
    let tiny = read("tiny");
    assert_eq!(shipped.config.model, tiny.model);
    assert_eq!(shipped.config.data.image_size, tiny.data.image_size);
    let additions = |config: &Config| (config.data.depths, config.data.color_steps);
    assert_eq!(additions(&shipped.config), additions(&tiny));
    assert_eq!(shipped.config.data.context_views, 24, "as reconstruct --help says");
    assert_eq!(shipped.stage, tiny.curriculum.final_stage());
    let fine_tune = read("fine_tune");
    assert_eq!(fine_tune.model, tiny.model, "what goes on from them");
    assert_eq!(additions(&fine_tune), additions(&tiny));
    let folder = folder().with_file_name("models");
    let files = std::fs::read_dir(&folder).expect("models/").map(|entry| entry.expect("an entry").path());
    let weights: Vec<PathBuf> =
        files.filter(|file| file.extension().is_some_and(|e| e == "safetensors")).collect();
    assert!(weights.contains(&folder.with_file_name(BUNDLED_MODEL)));
    let sizes: Vec<u64> = weights.iter().map(|file| file.metadata().expect("a file").len()).collect();
    assert!(
        sizes.iter().all(|&size| size <= 16_000_000) && sizes.iter().sum::<u64>() <= 48_000_000,
        "{sizes:?}"
    );
    for file in weights {
        let tensors = read_weights(&file).expect("weights").tensors;
        assert!(tensors.values().all(|tensor| tensor.kind() == Kind::BFloat16), "{}", file.display());
    }
}

/// Settings that shrink a configuration except for what distinguishes it from others.
const SHRUNKEN: [&str; 17] = [
    "model.latents=16",
    "model.width=32",
    "model.rgb_width=32",
    "model.ray_width=16",
    "model.rounds=1",
    "model.self_attention_blocks=1",
    "model.heads=4",
    "data.image_size=[32, 32]",
    "data.window=[4, 9]",
    "data.context_views=4",
    "data.target_views=2",
    "data.threads=1",
    "curriculum.boundaries=[1, 2, 2, 2]",
    "curriculum.transition=1",
    "loss.perceptual=none",
    "train.batch_size=1",
    "train.steps=3",
];

#[test]
fn every_configuration_trains() {
    let rooms = tempfile::tempdir().expect("a folder");
    write_room(&rooms.path().join("room"), 1, 9, [40, 40].into());
    let scenes = Arc::new(TrainingScenes::find(&[rooms.path().into()]).expect("a capture"));
    for entry in std::fs::read_dir(folder()).expect("configs/") {
        let path = entry.expect("an entry").path();
        let config = Config::read(&path, &SHRUNKEN.map(String::from)).unwrap_or_else(|e| panic!("{e}"));
        let mut trainer = Trainer::new(&config, scenes.clone(), Device::Cpu).expect("a trainer");
        let reports: Vec<_> = (0..3).map(|_| trainer.step(&mut || true).expect("a step")).collect();
        let name = path.display();
        assert!(
            reports.iter().all(|r| !r.skipped && r.losses.total.is_finite() && r.gradient_norm > 0.),
            "{name}"
        );
        let (first, last) = (reports[0].stage, reports[2].stage);
        assert_eq!(last.index, config.curriculum.final_stage, "{name}");
        assert!(config.curriculum.full_capacity || first.index == 0, "{name}");
        let consistent = reports.iter().any(|r| r.losses[Term::Consistency] > 0.);
        assert_eq!(consistent, config.loss.has_consistency(), "{name}: {reports:?}");
    }
}

#[test]
fn variants_show_as_many_gaussians_as_the_paper_says() {
    for (name, gaussians) in [
        ("re10k_2k", 2_048),
        ("re10k_2k_few_latents", 2_048),
        ("re10k_16k", 16_384),
        ("re10k_32k", 32_768),
        ("re10k_32k_dense", 32_768),
    ] {
        let config = read(name);
        assert_eq!(config.model.latents << config.curriculum.final_stage, gaussians, "{name}");
    }
}

#[test]
fn ablations_differ_from_the_full_model_in_one_thing() {
    let full = read("re10k_16k");
    let mut config = read("plucker_only");
    assert!(!config.model.camera_code);
    config.model.camera_code = true;
    assert_eq!(config, full);
    let mut config = read("no_consistency");
    assert!(!config.loss.has_consistency() && full.loss.has_consistency());
    config.loss = full.loss.clone();
    assert_eq!(config, full);
    let mut config = read("full_capacity");
    assert!(config.curriculum.full_capacity);
    config.curriculum.full_capacity = false;
    assert_eq!(config, full);
    let mut config = read("single_stream");
    assert_eq!(config.model.streams, Streams::Single);
    (config.model.streams, config.model.width) = (Streams::Dual, full.model.width);
    assert_eq!(config, full);
}
