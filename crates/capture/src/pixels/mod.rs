//! Processing of a photo between its file and a network: decoding, removal of lens distortion, cropping, resizing.

mod codec;
mod distortion;
mod fit;
mod heif;
mod jpeg;
mod lens;
mod mask;
mod metadata;
mod planes;
mod resample;

pub use codec::{
    DecodedPhoto, PHOTO_EXTENSIONS, decode_photo, encode_photo, encoded_image_size, read_image,
    read_image_size,
};
pub(crate) use codec::{SUPPORTED_IMAGES, has_alpha_channel};
pub use fit::{fit, source_region};
pub use metadata::{exif_focal, is_equirectangular};
pub use planes::{CHANNELS, Planes};
pub use resample::{Region, Resampler};

pub(crate) use distortion::Distortion;
pub(crate) use lens::{Lens, undistort};
pub(crate) use mask::{grey_to_rgb, multiply, read_mask};
