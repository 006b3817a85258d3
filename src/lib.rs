//! GlobalSplat: posed photos to a compact 3D Gaussian splat in one forward pass.
//!
//! ```no_run
//! use globalsplat::data::{Holdout, open_capture};
//! use globalsplat::io::write_splat;
//! use globalsplat::reconstruct::{load_context, reconstruct, shipped_model};
//!
//! # fn main() -> globalsplat::Result<()> {
//! let model = shipped_model(tch::Device::Cpu)?;
//! let capture = open_capture("captures/room".as_ref())?;
//! // Twelve photos, spread over the path of the camera and fitted to the model.
//! let views = load_context(&capture, Holdout::None, Some(12), model.config.data.image_size)?;
//! let reconstruction = reconstruct(&model, &views, &[])?;
//! write_splat("room.ply".as_ref(), &reconstruction.to_splat()?)?;
//! # Ok(())
//! # }
//! ```
//!
//! `examples/` has this as a program, and one that optimizes Gaussians on a photo with the differentiable splat op alone.
//!
//! Modules, from what a person touches down to the ground; each uses those below it and [`scene`]:
//! [`eval`] judges, [`train`] trains, [`refine`] makes splats sharp, [`reconstruct`] makes them of photos, [`config`] has what a
//! run depends on, [`optim`] and [`loss`] are what learning needs, [`data`] reads captures, [`synth`] makes them up, [`io`] has
//! files, [`ranks`] processes that train together, [`render`] is the differentiable splat op, [`model`] the network, [`scene`] camera maths.

#[doc(hidden)]
pub mod bench;
pub mod config;
pub mod data;
mod device;
pub mod error;
pub mod eval;
pub mod io;
pub mod loss;
pub mod model;
pub mod optim;
#[doc(hidden)]
pub mod parity;
pub mod ranks;
pub mod reconstruct;
pub mod refine;
pub mod render;
pub mod scene;
pub mod synth;
pub mod train;

pub use error::{Error, Result};
