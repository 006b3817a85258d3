//! Loading of training samples from captures, ahead of training: choice of scenes and views, and the loader threads.

mod bad_data;
mod group_cache;
mod loader;
mod order;
mod sample;
mod sampler;
mod scene;
mod scenes;
mod shard;

pub use bad_data::BadData;
pub use loader::DataLoader;
pub use sample::Batch;
pub use scene::{LoadTimes, LoadedScene};
pub use scenes::{SceneGroups, TrainingScenes};
pub use shard::BatchShard;

// Exchanged between processes.
pub(crate) use bad_data::BadSceneReport;
