//! Turns photos into a splat, as `globalsplat reconstruct` does:
//!
//!     cargo run --release --example reconstruct -- model.safetensors captures/room room.ply

use globalsplat::data::{Holdout, open_capture};
use globalsplat::io::write_splat;
use globalsplat::reconstruct::{load_context, load_model, reconstruct};
use globalsplat::{Error, Result};
use std::path::Path;
use tch::Device;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, weights, scene, out] = arguments.as_slice() else {
        return Err(Error::request("expected WEIGHTS SCENE OUT.ply"));
    };
    let model = load_model(Path::new(weights), Device::Cpu)?;
    let capture = open_capture(Path::new(scene))?;
    let data = &model.config.data;
    // The views are as many photos as the model saw in training, spread along the camera path, cropped and resized to the model's image
    // size.
    let views = load_context(&capture, Holdout::None, Some(data.context_views), data.image_size)?;

    let reconstruction = reconstruct(&model, &views, &[])?;
    // The model works in a normalized coordinate system; this transforms the result back to the capture's own.
    let splat = reconstruction.to_splat()?;
    write_splat(Path::new(out), &splat)?;
    println!("{out}: {} Gaussians from {} photos", splat.len(), views.len());
    Ok(())
}
