//! Images in the layout of the model: one plane per color channel.

use image::{Rgb, RgbImage};

/// Number of color channels of an image.
pub const CHANNELS: usize = 3;

/// An 8-bit image, `[3, H, W]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Planes {
    width: usize,
    height: usize,
    bytes: Vec<u8>,
}

impl Planes {
    /// Creates a black image.
    pub(super) fn new(width: u32, height: u32) -> Self {
        let (width, height) = (width as usize, height as usize);
        Planes { width, height, bytes: vec![0; CHANNELS * width * height] }
    }

    /// Converts an interleaved image to planes.
    pub fn from_rgb(image: &RgbImage) -> Self {
        let mut planes = Planes::new(image.width(), image.height());
        split_channels(image, &mut planes.bytes);
        planes
    }

    /// Converts the planes to an interleaved image.
    pub fn to_rgb(&self) -> RgbImage {
        let pixels = self.width * self.height;
        let at = |x: u32, y: u32| y as usize * self.width + x as usize;
        RgbImage::from_fn(self.width as u32, self.height as u32, |x, y| {
            Rgb(std::array::from_fn(|channel| self.bytes[channel * pixels + at(x, y)]))
        })
    }

    /// Returns the pixels, `[3, H, W]`, row by row.
    pub(super) fn bytes_mut(&mut self) -> &mut [u8] {
        &mut self.bytes
    }

    /// Returns (height, width) in pixels.
    pub fn size(&self) -> (usize, usize) {
        (self.height, self.width)
    }

    /// Returns the first channel, `[H, W]`, row by row.
    pub(crate) fn into_first_channel(mut self) -> Vec<u8> {
        self.bytes.truncate(self.width * self.height);
        self.bytes.shrink_to_fit();
        self.bytes
    }

    /// Returns the pixels, `[3, H, W]`, row by row.
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes
    }
}

/// Writes the channels of `image` into `planes`, `[3, H, W]`.
pub(super) fn split_channels(image: &RgbImage, planes: &mut [u8]) {
    let pixels = planes.len() / CHANNELS;
    let (red, rest) = planes.split_at_mut(pixels);
    let (green, blue) = rest.split_at_mut(pixels);
    let planes = red.iter_mut().zip(green).zip(blue);
    for (((red, green), blue), pixel) in planes.zip(image.as_raw().chunks_exact(CHANNELS)) {
        (*red, *green, *blue) = (pixel[0], pixel[1], pixel[2]);
    }
}
