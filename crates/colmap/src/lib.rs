#![doc = include_str!("../README.md")]

mod capture;
mod colmap;
mod photos;
mod poses;
mod process;
mod progress;
mod record;
mod video;

pub use capture::{CaptureOptions, make_capture};
pub use colmap::Colmap;
pub use globalsplat_files::{Error, Result};
pub use photos::SkippedPhoto;
pub use progress::{Progress, Step};
pub use record::{CaptureReport, Matching, VideoRecord};
pub use video::{VideoFrames, extract_frames};
