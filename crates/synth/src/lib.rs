#![doc = include_str!("../README.md")]

mod bvh;
mod dataset;
mod light;
mod mesh;
mod noise;
mod objects;
mod places;
mod random;
mod scene_builder;
mod sensor;
mod texture;
mod tracer;
mod video;
mod walk;

pub use dataset::SyntheticDataset;
pub use globalsplat_capture::{Error, Result};
pub use video::{Video, VideoSettings};
