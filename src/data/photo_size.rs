//! The size that photos are loaded at.

use crate::scene::{Camera, ImageSize};
use serde::Deserialize;
use std::str::FromStr;

/// Minimum length in pixels of a photo's shorter side after downscaling.
pub(crate) const MIN_SHORTER_SIDE: u32 = 32;

/// Minimum side in pixels of a photo that is scored or matched: the side of the SSIM window (spec 9.4).
pub const MIN_SIDE: u32 = 11;
/// Maximum side in pixels of a photo.
const MAX_SIDE: u32 = 16_384;

/// Size that the photos of a capture are loaded at.
///
/// ```
/// use globalsplat::data::PhotoSize;
/// use globalsplat::scene::{Camera, ImageSize, Intrinsics};
///
/// let intrinsics = Intrinsics { fx: 1500., fy: 1500., cx: 1000., cy: 500. };
/// let camera = Camera { intrinsics, c2w: Default::default(), width: 2000, height: 1000 };
/// assert_eq!(PhotoSize::Within(500).of(&camera), ImageSize { width: 500, height: 250 });
/// assert_eq!(PhotoSize::Within(4000).of(&camera), ImageSize { width: 2000, height: 1000 });
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub enum PhotoSize {
    /// The size that the photos have.
    Own,
    /// Photos whose longer side has more pixels are downscaled to this number, and keep their shape. The shorter side keeps at least 32.
    Within(u32),
    /// Photos are cropped and resized to this size.
    Exactly(ImageSize),
}

impl FromStr for PhotoSize {
    type Err = String;

    /// Parses the longer side, as in `1600`, or width and height, as in `640x480`.
    fn from_str(text: &str) -> Result<Self, String> {
        let side = |text: &str| text.parse().ok().filter(|side| (MIN_SIDE..=MAX_SIDE).contains(side));
        let size = match text.split_once('x') {
            Some((width, height)) => side(width)
                .zip(side(height))
                .map(|(width, height)| PhotoSize::Exactly(ImageSize { height, width })),
            None => side(text).map(PhotoSize::Within),
        };
        size.ok_or_else(|| {
            format!("expected the longer side, as in 1600, or WxH, as in 640x480, with sides of {MIN_SIDE} to {MAX_SIDE}")
        })
    }
}

impl TryFrom<String> for PhotoSize {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl PhotoSize {
    /// Returns the size of the photo of `camera` after loading.
    pub fn of(self, camera: &Camera) -> ImageSize {
        let Camera { width, height, .. } = *camera;
        self.resized(camera).unwrap_or(ImageSize { height, width })
    }

    /// Returns the size that the photo of `camera` is resized to, or `None` if it is loaded as it is.
    pub fn resized(self, camera: &Camera) -> Option<ImageSize> {
        let longest = match self {
            PhotoSize::Own => return None,
            PhotoSize::Exactly(size) => return Some(size),
            PhotoSize::Within(longest) => f64::from(longest),
        };
        let (longer, shorter) = (camera.width.max(camera.height), camera.width.min(camera.height));
        let scale = (longest / f64::from(longer)).max(f64::from(MIN_SHORTER_SIDE) / f64::from(shorter));
        let side = |pixels: u32| ((f64::from(pixels) * scale).round() as u32).max(1);
        (scale < 1.).then(|| ImageSize { height: side(camera.height), width: side(camera.width) })
    }
}
