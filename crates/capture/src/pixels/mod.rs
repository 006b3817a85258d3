//! Processing of a photo between its file and a network: decoding, removal of lens distortion, cropping, resizing.

mod codec;
mod fit;
mod jpeg;
mod planes;
mod resample;
mod undistort;

pub use codec::{
    DecodedPhoto, PHOTO_EXTENSIONS, decode_photo, encode_photo, encoded_image_size, read_image,
    read_image_size,
};
pub use fit::{fit, source_region};
pub use planes::{CHANNELS, Planes};
pub use resample::{Region, Resampler};

pub(crate) use undistort::{LookupTable, ViewPixels, undistort};
