//! COLMAP, as a program or as the Python package pycolmap: found, called, and its results read.

mod command;
mod find;
mod model;
mod pairs;

pub use find::{Colmap, VARIABLE};

pub(crate) use command::{Command, Outcome};
pub(crate) use model::{ModelSummary, model_folders, read_models};
pub(crate) use pairs::{exhaustive_pairs, sequential_pairs};

/// Camera models that COLMAP 4 estimates. Versions before 4 lack the last ones.
pub const CAMERA_MODELS: [&str; 18] = [
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "OPENCV_FISHEYE",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
];
