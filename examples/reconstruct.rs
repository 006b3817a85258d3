//! Photos to a splat, as `globalsplat reconstruct` does it:
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
        return Err(Error::Request("expected WEIGHTS SCENE OUT.ply".into()));
    };
    let model = load_model(Path::new(weights), Device::Cpu)?;
    let capture = open_capture(Path::new(scene))?;
    let data = &model.config.data;
    // As many as the model saw in training, spread over the path of the camera, cut and resized to what it takes.
    let views = load_context(&capture, Holdout::None, Some(data.context_views), data.image_size)?;

    let reconstruction = reconstruct(&model, &views, &[])?;
    // The model works in a world in which all scenes are alike; this is the way back to the capture's own.
    let splat = reconstruction.to_splat()?;
    write_splat(Path::new(out), &splat)?;
    println!("{out}: {} Gaussians from {} photos", splat.gaussians.count(), views.len());
    Ok(())
}
