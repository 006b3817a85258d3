//! GlobalSplat: posed photos to a compact 3D Gaussian splat in one forward pass.
//!
//! Data flows down this list; an arrow never points up.
//! [`data`] → [`scene`] → [`model`] → [`render`] → [`loss`] → [`train`] → [`eval`], with [`io`] for files.

pub mod error;
pub mod io;
pub mod loss;
pub mod model;
pub mod render;
pub mod scene;

pub use error::{Error, Result};
