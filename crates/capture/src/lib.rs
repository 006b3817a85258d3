#![doc = include_str!("../README.md")]

mod camera_path;
mod capture;
mod formats;
mod geo;
mod geometry;
mod holdout;
mod image_source;
mod lens;
mod npy;
mod open;
mod photos;
mod pixels;

pub use camera_path::{CameraPath, read_camera_path};
pub use capture::{CAPTURE_RECORD, Capture, Photo};
pub use formats::cameras_json::write_cameras_json;
#[cfg(feature = "chunks")]
pub use formats::chunk::{CAMERA_NUMBERS, CHUNK_EXTENSION, CHUNK_INDEX_FILE, Chunk, camera_numbers};
pub use formats::colmap::{ColmapModel, Point, read_colmap_models, read_points};
pub use formats::folder_name;
pub use formats::polycam::is_polycam;
pub use formats::transforms_json::write_transforms_json;
pub use geo::{GEO_FILE, GeoPosition, read_geo_positions, to_east_north_up};
pub use geometry::{
    Camera, ImageSize, Intrinsics, LocalFrame, Normalization, PositionFit, Similarity, UpSource, Upright,
    check_pose, estimate_upright, fit_positions, look_at, normalize, orbit_around_cameras,
    orbit_around_point, pose_to_rows, smooth_path,
};
pub use globalsplat_files::{Error, Result};
pub use holdout::Holdout;
pub use image_source::ImageSource;
pub use lens::{COLMAP_MODELS, Lens};
pub use npy::read_npy;
pub use open::{FoundCaptures, find_captures, is_capture, open_capture};
pub use photos::{MASKS_FOLDER, PhotoList, find_masks, find_masks_in, format_names, list_photos};
pub use pixels::{
    CHANNELS, DecodedPhoto, PHOTO_EXTENSIONS, Planes, Region, Resampler, decode_photo, decode_upright,
    encode_photo, encode_upright, exif_focal, exif_position, fit_mask, gray_to_rgb, is_equirectangular,
    read_image, read_image_size, resize_and_crop,
};
