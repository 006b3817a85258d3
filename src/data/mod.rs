//! Captures: posed photos on disk. This module reads, checks and resizes them and converts them to tensors.

mod batch;
mod capture;
mod config;
mod dataset;
mod formats;
mod holdout;
mod loading;
mod pixels;
mod polyphase;
mod room;
mod synthetic_dataset;

pub(crate) use batch::cameras_at;
pub use batch::{ViewBatch, view_batch};
pub use capture::{Capture, View};
pub use config::{DataConfig, JitterConfig, Sampling};
pub use dataset::{Dataset, OpenGroup, SceneGroup, Split};
pub use formats::{
    CameraPath, Chunk, ChunkWriter, FoundCaptures, INDEX_FILE, Point, find_captures, open_capture, points_of,
    read_camera_path, write_cameras_json,
};
pub use holdout::Holdout;
pub use loading::{BadData, LoadTimes, LoadedScene, Loader, Part, Sample, SceneGroups, TrainingScenes};
pub use pixels::{Planes, fit};
pub use polyphase::polyphase;
pub use room::write_room;
pub use synthetic_dataset::{SyntheticDataset, read_pictures};

// Exchanged between processes.
pub(crate) use loading::News;
// Used by the parity checks, which run every part separately.
pub(crate) use pixels::{Jitter, Region, Resampler};
