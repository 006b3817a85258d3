//! Posed photos as tensors: batches of views, augmentation, and loading for training. Captures are read by the crate
//! `globalsplat_capture`, synthetic ones are made by `globalsplat_synth`.

mod augment;
mod batch;
mod chunk_writer;
mod config;
mod dataset;
mod loading;
#[cfg(feature = "cli")]
mod nerf_writer;
mod view;

pub use batch::{ViewBatch, view_batch};
pub(crate) use batch::{cameras_at, select_views, view_matrices};
pub use chunk_writer::ChunkWriter;
#[cfg(feature = "cli")]
pub(crate) use chunk_writer::write_unless_other;
pub use config::{DataConfig, JitterConfig, Sampling};
pub use dataset::{Dataset, OpenGroup, SceneGroup, Split};
pub use globalsplat_capture::{
    CHUNK_INDEX_FILE as INDEX_FILE, CameraPath, Capture, Chunk, FoundCaptures, Holdout, ImageSource, Planes,
    Point, find_captures, open_capture, read_camera_path, read_npy, read_points, resize_and_crop,
    write_cameras_json, write_transforms_json,
};
pub use globalsplat_synth::SyntheticDataset;
pub use loading::{BadData, Batch, BatchShard, DataLoader, LoadedScene, SceneGroups, TrainingScenes};
#[cfg(feature = "cli")]
pub(crate) use nerf_writer::write_nerf_capture;
pub(crate) use view::{MIN_SHORTER_SIDE, read_in_batches};
pub use view::{MIN_SIDE, PhotoSize, Pixels, View, load_all_views, load_views, tensor_from_planes};
#[cfg(test)]
pub(crate) use view::{WALL_SIDE, wall};

// Exchanged between processes.
pub(crate) use loading::BadSceneReport;
// Used by the parity checks, which run every part separately.
pub(crate) use augment::Jitter;
pub(crate) use globalsplat_capture::{Region, Resampler};
