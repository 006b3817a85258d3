//! Captures: posed photos on disk, read, checked, resized, and put into tensors.

mod batch;
mod cameras_json;
mod capture;
mod chunk;
mod colmap;
mod dataset;
mod distortion;
mod holdout;
mod preprocess;
mod sampler;
mod spread;
mod transforms_json;

pub use batch::{ViewBatch, view_batch};
pub use cameras_json::write_cameras_json;
pub use capture::{Capture, View, find_captures, open_capture, read_camera_path};
pub use chunk::{Chunk, ChunkWriter, INDEX_FILE};
pub use dataset::{Dataset, OpenGroup, SceneGroup, Split};
pub use holdout::Holdout;
pub use preprocess::{ImageSize, fit};
pub use sampler::{Sample, Sampler};
pub use spread::spread_over_path;
