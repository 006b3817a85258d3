//! Where real data and golden tensors are found, and how tensors are compared.
#![allow(dead_code)] // every test binary uses its own part

pub mod browser;
pub mod formats;
pub mod program;

use rand::{Rng, SeedableRng, rngs::StdRng};
use std::path::{Path, PathBuf};
use tch::{Kind, Tensor};

/// The folder that `variable` names, else `../shared/<name>`. Where neither is there, says so: the caller returns early.
fn outside(variable: &str, name: &str) -> Option<PathBuf> {
    let path = match std::env::var_os(variable) {
        Some(path) => PathBuf::from(path),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared").join(name),
    };
    if path.is_dir() {
        return Some(path);
    }
    println!("skipped: {} is not there; set {variable}", path.display());
    None
}

/// Golden tensors.
pub fn golden() -> Option<PathBuf> {
    outside("GLOBALSPLAT_GOLDEN", "golden")
}

/// Real captures: folders with `cameras.json` and a published `reference.ply` under `re10k`.
pub fn captures() -> Option<Vec<PathBuf>> {
    let root = outside("GLOBALSPLAT_CAPTURES", "data")?;
    let root = if root.join("re10k").is_dir() { root.join("re10k") } else { root };
    let mut captures: Vec<PathBuf> = std::fs::read_dir(&root)
        .expect("a readable folder")
        .map(|entry| entry.expect("a readable entry").path())
        .filter(|path| path.join("cameras.json").is_file())
        .collect();
    captures.sort();
    if captures.is_empty() {
        println!("skipped: no capture under {}", root.display());
        return None;
    }
    Some(captures)
}

/// A real capture with a `transforms.json` and a distorting lens, under `nerfstudio`.
pub fn fox() -> Option<PathBuf> {
    let fox = outside("GLOBALSPLAT_CAPTURES", "data")?.join("nerfstudio/fox");
    if fox.is_dir() {
        return Some(fox);
    }
    println!("skipped: {} is not there", fox.display());
    None
}

/// ‖a − b‖ / ‖b‖.
pub fn relative_error(a: &Tensor, b: &Tensor) -> f64 {
    assert_eq!(a.size(), b.size());
    let (a, b) = (a.to_kind(Kind::Double), b.to_kind(Kind::Double));
    ((&a - &b).norm() / b.norm()).double_value(&[])
}

/// Largest |a − b|.
pub fn largest_error(a: &Tensor, b: &Tensor) -> f64 {
    assert_eq!(a.size(), b.size());
    (a.to_kind(Kind::Double) - b.to_kind(Kind::Double)).abs().max().double_value(&[])
}

/// Random numbers of a test's own: torch's generator is shared by all threads, so tests would take each other's.
pub struct Random(StdRng);

impl Random {
    pub fn new(seed: u64) -> Self {
        Random(StdRng::seed_from_u64(seed))
    }

    /// float64 in [0, 1).
    pub fn uniform(&mut self, shape: &[i64]) -> Tensor {
        let values: Vec<f64> = (0..shape.iter().product::<i64>()).map(|_| self.0.random()).collect();
        Tensor::from_slice(&values).view(shape)
    }

    /// float64 in [−1, 1).
    pub fn symmetric(&mut self, shape: &[i64]) -> Tensor {
        self.uniform(shape) * 2. - 1.
    }
}
