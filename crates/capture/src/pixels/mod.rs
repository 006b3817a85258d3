//! Processing of a photo between its file and a network: decoding, removal of lens distortion, cropping, resizing.

mod codec;
mod heif;
mod jpeg;
mod mask;
mod metadata;
mod planes;
mod resample;
mod resize_and_crop;
mod undistort;

#[cfg(feature = "chunks")]
pub(crate) use codec::encoded_image_size;
pub use codec::{
    DecodedPhoto, PHOTO_EXTENSIONS, decode_photo, decode_upright, encode_photo, encode_upright, read_image,
    read_image_size,
};
pub(crate) use codec::{SUPPORTED_IMAGES, has_alpha_channel};
pub use metadata::{exif_focal, exif_position, is_equirectangular};
pub use planes::{CHANNELS, Planes};
pub use resample::{Region, Resampler};
pub use resize_and_crop::resize_and_crop;
pub(crate) use resize_and_crop::source_window;

pub(crate) use mask::{add_background, multiply, read_mask};
pub use mask::{fit_mask, gray_to_rgb};
pub(crate) use undistort::undistort;
