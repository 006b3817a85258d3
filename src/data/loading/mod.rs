//! What makes samples of captures, ahead of training: which scenes, which views, on which thread.

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

// For processes that tell each other.
pub(crate) use bad_data::News;
