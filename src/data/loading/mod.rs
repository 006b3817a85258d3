//! What makes samples of captures, ahead of training: which scenes, which views, on which thread.

mod bad_data;
mod loader;
mod open_groups;
mod order;
mod sample;
mod sampler;
mod scene;
mod scenes;

pub use bad_data::BadData;
pub use loader::Loader;
pub use sample::Sample;
pub use scene::{LoadTimes, LoadedScene};
pub use scenes::{SceneGroups, TrainingScenes};
