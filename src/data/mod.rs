//! Captures: posed photos on disk, read, checked, resized, and put into tensors.

mod augment;
mod bad_data;
mod batch;
mod cameras_json;
mod capture;
mod colmap;
mod distortion;
mod holdout;
mod jitter;
mod loader;
mod open_groups;
mod order;
mod planes;
mod preprocess;
mod resample;
mod sample;
mod sampler;
mod scenes;
mod transforms_json;

pub use augment::Augmentation;
pub use bad_data::BadData;
pub use batch::{ViewBatch, view_batch};
pub use cameras_json::write_cameras_json;
pub use capture::{Capture, View, find_captures, open_capture, read_camera_path};
pub use holdout::{Holdout, spread};
pub use jitter::{Adjustment, Jitter, JitterConfig};
pub use loader::{LoadTimes, LoadedScene, Loader};
pub use order::{Order, Place};
pub use planes::Planes;
pub use preprocess::{ImageSize, fit};
pub use resample::{Region, Resampler};
pub use sample::Sample;
pub use sampler::{ChosenViews, Sampling, choose_views};
pub use scenes::SceneGroups;
