#![doc = include_str!("../README.md")]

mod capture;
mod formats;
mod geometry;
mod holdout;
mod image_source;
mod lens;
mod pixels;

pub use capture::{Capture, Photo};
#[cfg(feature = "chunks")]
pub use formats::{CHUNK_EXTENSION, CHUNK_INDEX_FILE, Chunk, camera_numbers};
pub use formats::{
    CameraPath, CaptureFolders, FoundCaptures, MASKS_FOLDER, PhotoList, Point, capture_folders,
    find_captures, find_masks, find_masks_in, folder_name, is_capture, list_photos, open_capture,
    read_camera_path, read_points, write_cameras_json, write_transforms_json,
};
pub use geometry::{
    Camera, ImageSize, Intrinsics, LocalFrame, Normalization, Similarity, check_pose, normalize,
    orbit_around_cameras, orbit_around_point, pose_to_rows, smooth_path,
};
pub use globalsplat_files::{Error, Result};
pub use holdout::Holdout;
pub use image_source::ImageSource;
pub use lens::Lens;
pub use pixels::{
    CHANNELS, DecodedPhoto, PHOTO_EXTENSIONS, Planes, Region, Resampler, decode_photo, encode_photo,
    exif_focal, grey_to_rgb, is_equirectangular, read_image, read_image_size, read_mask, resize_and_crop,
    source_ranges,
};
