#![doc = include_str!("../README.md")]

mod video;

pub use globalsplat_files::{Error, Result};
pub use video::{VideoFrames, VideoOptions, VideoPass, VideoProgress, extract_frames, is_video};
