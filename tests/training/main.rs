//! Tests of training: configurations, runs and their resumption, several processes.

#[path = "../common/mod.rs"]
mod common;

mod configs;
mod distributed;
mod runs;

use common::program::arg;
use globalsplat::train::{latest_checkpoint, list_checkpoints};
use serde_json::Value;
use std::fs;
use std::path::Path;

/// Returns the line that trains in the sandbox's folder `run`, with `settings` separated by spaces.
fn train(run: &str, settings: &str) -> String {
    let settings = settings.split_whitespace().map(|setting| format!(" --set {setting}"));
    format!("train --config @tiny.toml --out @{run}{}", settings.collect::<String>())
}

/// Returns the lines of metrics.jsonl about steps, and those about validations.
fn metrics(run: &Path) -> (Vec<Value>, Vec<Value>) {
    let text = fs::read_to_string(run.join("metrics.jsonl")).unwrap_or_default();
    // The last line may be incomplete.
    let lines = text.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let (validations, steps) = lines.partition(|line| line["validation"].is_object());
    (steps, validations)
}

/// Returns the steps that metrics.jsonl records, and those after which it records a validation.
fn steps(run: &Path) -> (Vec<u64>, Vec<u64>) {
    let (steps, validations) = metrics(run);
    let numbers = |lines: Vec<Value>| lines.iter().map(|line| line["step"].as_u64().unwrap()).collect();
    (numbers(steps), numbers(validations))
}

/// Returns the number of steps before each checkpoint.
fn checkpoints(run: &Path) -> Vec<u64> {
    let paths = list_checkpoints(run).unwrap();
    paths.iter().map(|path| arg(path).rsplit_once('-').unwrap().1.parse().unwrap()).collect()
}

/// Asserts that the last checkpoints of both runs have the same bytes.
#[track_caller]
fn assert_same_bits(a: &Path, b: &Path) {
    let [a, b] = [a, b].map(|run| latest_checkpoint(run).unwrap());
    assert_eq!(a.file_name(), b.file_name());
    for file in ["model.safetensors", "optimizer.safetensors", "state.json"] {
        assert!(fs::read(a.join(file)).unwrap() == fs::read(b.join(file)).unwrap(), "{file}");
    }
}
