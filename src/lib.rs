//! GlobalSplat: posed photos to a compact 3D Gaussian splat in one forward pass.
//!
//! ```no_run
//! use globalsplat::data::{Holdout, open_capture};
//! use globalsplat::io::write_splat;
//! use globalsplat::reconstruct::{load_context, reconstruct, bundled_model};
//!
//! # fn main() -> globalsplat::Result<()> {
//! let model = bundled_model(tch::Device::Cpu)?;
//! let capture = open_capture("captures/room".as_ref())?;
//! // Twelve photos, spread along the camera path and resized to the model's image size.
//! let views = load_context(&capture, Holdout::None, Some(12), model.config.data.image_size)?;
//! let reconstruction = reconstruct(&model, &views, &[])?;
//! write_splat("room.ply".as_ref(), &reconstruction.to_splat()?)?;
//! # Ok(())
//! # }
//! ```
//!
//! `examples/` contains this as a program, and another that optimizes Gaussians to fit one photo with the differentiable splat
//! op alone.
//!
//! Modules, from the highest level to the lowest; each uses only those after it in this list, and [`scene`]:
//! [`refine`] optimizes a splat per scene, [`eval`] evaluates methods, [`train`] trains, [`reconstruct`] turns photos into splats,
//! [`metrics`] compares images, [`config`] defines the configuration of a run, [`optim`] and [`loss`] hold the optimizer and the
//! losses, [`quality`] tells what to expect of a capture, [`data`] reads captures, [`stereo`] estimates depths, [`synth`] generates synthetic scenes, [`io`] reads and writes files,
//! [`distributed`] connects the processes of distributed training, [`render`] is the differentiable splat op, [`model`] the network.

#[cfg(feature = "cli")]
mod cli;
pub mod config;
pub mod data;
pub mod device;
pub mod distributed;
pub mod error;
pub mod eval;
mod ffi;
pub mod io;
pub mod loss;
pub mod metrics;
pub mod model;
pub mod optim;
pub mod quality;
pub mod reconstruct;
pub mod refine;
pub mod render;
pub mod scene;
pub mod stereo;
pub mod train;

#[cfg(feature = "cli")]
#[doc(hidden)]
pub use cli::{main, run};
pub use error::{Error, Result};
pub use globalsplat_synth as synth;

/// Compiles the example of the README.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
