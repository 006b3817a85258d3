//! Captures: posed photos on disk, read, checked, resized, and put into tensors.

mod batch;
mod cameras_json;
mod capture;
mod colmap;
mod distortion;
mod holdout;
mod planes;
mod preprocess;
mod resample;
mod sampler;
mod transforms_json;

pub use batch::{ViewBatch, view_batch};
pub use cameras_json::write_cameras_json;
pub use capture::{Capture, View, find_captures, open_capture, read_camera_path};
pub use holdout::{Holdout, spread};
pub use planes::Planes;
pub use preprocess::{ImageSize, fit};
pub use resample::{Region, Resampler};
pub use sampler::{Sample, Sampler};
