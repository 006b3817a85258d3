//! GlobalSplat: posed photos to a compact 3D Gaussian splat in one forward pass.
//!
//! Data flows down this list; an arrow never points up.
//! [`data`] → [`scene`] → [`model`] → [`render`] → [`loss`] → [`train`] → [`eval`] → [`bench`], with [`io`] for files.

pub mod bench;
pub mod config;
pub mod data;
pub mod error;
pub mod eval;
pub mod io;
pub mod loss;
pub mod model;
pub mod parity;
pub mod render;
pub mod scene;
pub mod synth;
pub mod train;

pub use error::{Error, Result};
