//! Tests of the interactive page and of other viewers, in a browser.

#[path = "../common/mod.rs"]
mod common;

mod view;
mod viewers;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use globalsplat::io::{Splat, read_image, tensor_from_rgb};
use globalsplat::metrics::psnr;
use globalsplat::render::render_views;
use globalsplat::scene::{Camera, Gaussians};
use tch::Tensor;

/// Minimum PSNR between an image in a browser and our own render, in dB.
const LEAST: f64 = 25.;

/// Returns a PNG in base64 as a tensor [3, H, W].
fn picture_from_base64(png: &str) -> Tensor {
    let file = tempfile::NamedTempFile::with_suffix(".png").unwrap();
    std::fs::write(&file, STANDARD.decode(png).unwrap()).unwrap();
    tensor_from_rgb(&read_image(file.path()).unwrap())
}

/// Returns our own render of a splat, as a screen shows it.
fn own_picture(splat: &Splat, camera: Camera) -> Tensor {
    render_views(&Gaussians::from_splat(splat), &[camera]).unwrap().remove(0).rgb.clamp(0., 1.)
}

/// Checks and prints the PSNR between an image in a browser and our own render.
#[track_caller]
fn assert_like(what: &str, picture: &Tensor, own: &Tensor, least: f64) {
    let psnr = psnr(picture, own);
    println!("{what}: {psnr:.2} dB");
    assert!(psnr >= least, "{what}: {psnr:.2} dB");
}
