#![doc = include_str!("../README.md")]

mod colmap;
mod estimate;
mod make_capture;
mod photos;
mod record;
mod video;

pub use colmap::{CAMERA_MODELS, Colmap, VARIABLE};
pub use estimate::{PoseOptions, PoseProgress, estimate_poses};
pub use globalsplat_files::{Error, Result};
pub use make_capture::{CaptureOptions, CaptureProgress, CaptureReport, VideoRecord, make_capture};
pub use photos::SkippedPhoto;
pub use record::{Matching, PoseReport, Step};
pub use video::{VideoFrames, VideoOptions, VideoPass, VideoProgress, extract_frames};
