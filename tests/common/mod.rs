//! Test utilities that need libtorch or the program. The others are in the crate `globalsplat_test_kit`.
#![allow(dead_code, unused_imports)] // every test binary uses only a part

pub mod browser;
pub mod program;
pub mod room;

pub use globalsplat_test_kit::formats;
pub use globalsplat_test_kit::{captures, exit_code_of_test, fox, golden, rerun_test, skip};

use globalsplat::io::{find_pretrained, read_image, tensor_from_rgb};
use globalsplat::loss::PerceptualBackbone;
use image::RgbImage;
use rand::{Rng, SeedableRng, rngs::StdRng};
use std::path::Path;
use tch::{Kind, Tensor};

/// Returns `true` if the weights of LPIPS are available; otherwise, skips the test.
pub fn has_lpips() -> bool {
    let has = PerceptualBackbone::LPIPS.iter().all(|network| find_pretrained(&network.file_name()).is_some());
    if !has {
        skip("the weights of LPIPS", "the LPIPS weights are missing; run make weights");
    }
    has
}

/// Returns `true` if the program contains the viewer; otherwise, skips the test.
pub fn has_viewer() -> bool {
    let found = Path::new(env!("CARGO_MANIFEST_DIR")).join("web/dist/page.js").exists();
    if !found {
        skip(
            "the page's viewer",
            "web/ isn't bundled; install Node.js 20 or newer with npm and run make build",
        );
    }
    found
}

/// Writes the shell script `lines` to `path`, as a program.
#[cfg(unix)]
pub fn write_script(path: &Path, lines: &str) {
    use std::os::unix::fs::PermissionsExt;
    std::fs::write(path, format!("#!/bin/sh\n{lines}\n")).unwrap();
    std::fs::set_permissions(path, PermissionsExt::from_mode(0o755)).unwrap();
}

/// Returns the images in `folder`, sorted by name.
pub fn pictures(folder: &Path) -> Vec<RgbImage> {
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files.iter().map(|file| read_image(file).unwrap()).collect()
}

/// Returns the PSNR of two images in dB.
pub fn psnr(a: &RgbImage, b: &RgbImage) -> f64 {
    globalsplat::metrics::psnr(&tensor_from_rgb(a), &tensor_from_rgb(b))
}

/// Returns the relative error ‖a − b‖ / ‖b‖.
pub fn relative_error(a: &Tensor, b: &Tensor) -> f64 {
    assert_eq!(a.size(), b.size());
    let (a, b) = (a.to_kind(Kind::Double), b.to_kind(Kind::Double));
    ((&a - &b).norm() / b.norm()).double_value(&[])
}

/// Returns the largest |a − b|.
pub fn largest_error(a: &Tensor, b: &Tensor) -> f64 {
    assert_eq!(a.size(), b.size());
    (a.to_kind(Kind::Double) - b.to_kind(Kind::Double)).abs().max().double_value(&[])
}

/// Random number generator of one test: torch's generator is shared by all threads, so tests would affect each other's numbers.
pub struct Random(StdRng);

impl Random {
    pub fn new(seed: u64) -> Self {
        Random(StdRng::seed_from_u64(seed))
    }

    /// Returns float64 values, uniform in [0, 1).
    pub fn uniform(&mut self, shape: &[i64]) -> Tensor {
        let values: Vec<f64> = (0..shape.iter().product::<i64>()).map(|_| self.0.random()).collect();
        Tensor::from_slice(&values).view(shape)
    }

    /// Returns float64 values, uniform in [−1, 1).
    pub fn symmetric(&mut self, shape: &[i64]) -> Tensor {
        self.uniform(shape) * 2. - 1.
    }
}
