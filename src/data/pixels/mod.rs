//! Processing of a photo between its file and the model: removal of lens distortion, cropping, resizing, colour jitter.

mod augment;
mod distortion;
mod fit;
mod jitter;
mod lens;
mod planes;
mod resample;

pub use fit::{fit, looked_at};
pub use planes::Planes;

pub(crate) use jitter::Jitter;
pub(crate) use resample::{Region, Resampler};

pub(in crate::data) use augment::Augmentation;
pub(in crate::data) use distortion::Distortion;
pub(in crate::data) use lens::{Lens, undistort};
pub(in crate::data) use planes::CHANNELS;
