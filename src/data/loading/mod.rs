//! Loading of training samples from captures, ahead of training: choice of scenes and views, and the loader threads.

mod bad_data;
mod loader;
mod open_groups;
mod order;
mod part;
mod sample;
mod sampler;
mod scene;
mod scenes;

pub use bad_data::BadData;
pub use loader::Loader;
pub use part::Part;
pub use sample::Sample;
pub use scene::{LoadTimes, LoadedScene};
pub use scenes::{SceneGroups, TrainingScenes};

// Exchanged between processes.
pub(crate) use bad_data::News;
