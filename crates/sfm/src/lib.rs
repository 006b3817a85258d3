#![doc = include_str!("../README.md")]

mod colmap;
mod estimate;
mod photos;
mod record;
mod video;

pub use colmap::{CAMERA_MODELS, Colmap, VARIABLE};
pub use estimate::{Matching, PoseOptions, PoseProgress, PoseReport, Step, estimate_poses};
pub use globalsplat_files::{Error, Result};
pub use photos::SkippedPhoto;
pub use video::{VideoFrames, VideoOptions, VideoPass, VideoProgress, extract_frames, is_video};
