//! Photos in memory: their size, their pixels, and views, which are photos with their cameras.

use crate::error::{Error, Result};
use crate::io::rgb_from_tensor;
use crate::scene::{Camera, ImageSize};
use crate::stereo::SmallPhoto;
use globalsplat_capture::{CHANNELS, Capture, Photo, Planes, resize_and_crop};
use rayon::prelude::*;
use serde::Deserialize;
use std::str::FromStr;
use tch::{Device, Kind, Tensor};

/// Pixels of a photo or of its mask, `[C, H, W]`: floats, nominally in [0, 1], or the 8-bit levels of a file, which take a quarter of the
/// memory.
#[derive(Debug)]
pub struct Pixels(Tensor);

impl From<Tensor> for Pixels {
    /// Takes floats, or levels from 0 to 255 of kind `Uint8`.
    ///
    /// # Panics
    /// If the tensor has another kind.
    fn from(values: Tensor) -> Self {
        assert!(matches!(values.kind(), Kind::Float | Kind::Uint8), "pixels are floats or 8-bit levels");
        Pixels(values)
    }
}

impl Pixels {
    /// Returns the pixels as floats; level 255 becomes 1. Floats are not copied.
    pub fn to_float(&self) -> Tensor {
        match self.0.kind() {
            // Divide in place: a second copy of a photo of 16 million pixels takes 192 MB.
            Kind::Uint8 => self.0.to_kind(Kind::Float).divide_scalar_(255.),
            _ => self.0.shallow_clone(),
        }
    }

    /// Returns the pixels of several images of one size as floats, `[N, C, H, W]`.
    pub(crate) fn stack(images: &[&Pixels]) -> Tensor {
        let is_of_levels = images.iter().all(|image| image.0.kind() == Kind::Uint8);
        match is_of_levels {
            true => {
                Pixels(Tensor::stack(&images.iter().map(|image| &image.0).collect::<Vec<_>>(), 0)).to_float()
            }
            false => Tensor::stack(&images.iter().map(|image| image.to_float()).collect::<Vec<_>>(), 0),
        }
    }

    /// Returns `count` images of 8-bit levels that are not initialized, of a size [C, H, W], in one allocation: small tensors that are
    /// allocated one by one between larger ones, which are freed, would leave gaps in memory where no larger one fits.
    pub(crate) fn allocate(count: i64, [channels, height, width]: [i64; 3], device: Device) -> Vec<Self> {
        let levels = Tensor::empty([count, channels, height, width], (Kind::Uint8, device));
        (0..count).map(|index| Pixels(levels.get(index))).collect()
    }

    /// Overwrites 8-bit levels with floats, limited to [0, 1] and rounded to the nearest level.
    pub(crate) fn copy_from_floats(&mut self, floats: &Tensor) {
        assert_eq!(self.0.kind(), Kind::Uint8, "floats would not be rounded");
        self.0.copy_(&(floats.clamp(0., 1.) * 255.).round_());
    }

    /// Returns the size, [C, H, W].
    pub fn size(&self) -> Vec<i64> {
        self.0.size()
    }

    /// Returns a copy that shares the memory.
    pub fn shallow_clone(&self) -> Self {
        Pixels(self.0.shallow_clone())
    }

    /// Returns the pixels on `device`.
    pub(crate) fn to_device(&self, device: Device) -> Self {
        Pixels(self.0.to_device(device))
    }
}

/// Minimum length in pixels of a photo's shorter side after downscaling.
pub(crate) const MIN_SHORTER_SIDE: u32 = 32;

/// Minimum side in pixels of a photo that is scored or matched: the side of the SSIM window (spec 9.4).
pub const MIN_SIDE: u32 = 11;
/// Number of photos that are read between two calls of `should_continue`.
const READ_AT_ONCE: usize = 8;
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

/// A photo and its camera.
#[derive(Debug)]
pub struct View {
    /// Name of the image in the capture.
    pub name: String,
    /// Colors, `[3, H, W]`.
    pub image: Pixels,
    /// Weight of each pixel, `[1, H, W]`: 1 where the pixel counts, 0 where it is masked out. `None` if every pixel counts.
    pub mask: Option<Pixels>,
    /// Camera at the size of `image`.
    pub camera: Camera,
}

impl From<Photo> for View {
    fn from(Photo { name, image, mask, camera }: Photo) -> Self {
        let (height, width) = image.size();
        let mask = mask.map(|mask| Tensor::from_slice(&mask).view([1, height as i64, width as i64]).into());
        View { name, image: byte_tensor(&image).into(), mask, camera }
    }
}

impl View {
    /// Returns a copy that shares the pixels.
    pub fn shallow_clone(&self) -> Self {
        let mask = self.mask.as_ref().map(Pixels::shallow_clone);
        View { name: self.name.clone(), image: self.image.shallow_clone(), mask, camera: self.camera }
    }

    /// Returns the mask, in which every pixel counts if the view has none.
    pub(crate) fn mask_or_ones(&self) -> Pixels {
        let ones = || {
            let size = self.image.size();
            Tensor::full([1, size[1], size[2]], 255, (Kind::Uint8, Device::Cpu)).into()
        };
        self.mask.as_ref().map_or_else(ones, Pixels::shallow_clone)
    }

    /// Returns the fraction of the pixels that count, the mean weight of the mask; `None` if every pixel counts.
    pub fn pixel_fraction(&self) -> Option<f64> {
        self.mask.as_ref().map(|mask| mask.to_float().mean(Kind::Double).double_value(&[]))
    }

    /// Returns `true` if no pixel counts.
    pub fn is_masked_out(&self) -> bool {
        self.pixel_fraction() == Some(0.)
    }

    /// Returns the view with at most `longest_side` pixels along its longer side, on the CPU.
    pub(crate) fn to_small_photo(&self, longest_side: f64) -> SmallPhoto {
        let on_cpu = |pixels: &Pixels| pixels.to_float().to_device(Device::Cpu);
        let (image, mask) = (on_cpu(&self.image), self.mask.as_ref().map(on_cpu));
        SmallPhoto::new(&self.name, &image, mask.as_ref(), self.camera, longest_side)
    }

    /// Returns the view fitted to `size` as [`load_views`] does, without reading the photo again.
    ///
    /// # Errors
    /// Fails if libtorch rejects the image because of its shape.
    pub fn fitted(&self, size: ImageSize) -> Result<Self> {
        let (planes, camera) = resize_and_crop(&rgb_from_tensor(&self.image.to_float())?, &self.camera, size);
        let fit_mask = |mask: &Pixels| -> Result<Pixels> {
            let mask = rgb_from_tensor(&mask.to_float().expand([3, -1, -1], false))?;
            let (planes, _) = resize_and_crop(&mask, &self.camera, size);
            Ok(byte_tensor(&planes).narrow(0, 0, 1).copy().into())
        };
        let mask = self.mask.as_ref().map(fit_mask).transpose()?;
        Ok(View { name: self.name.clone(), image: byte_tensor(&planes).into(), mask, camera })
    }
}

/// Reads the photos `indices` of `capture` at `size`, a few at a time, and passes them to `use_views` in their order. `should_continue` is
/// called with the number of photos read so far. Returns `false` if it has ended the work.
///
/// # Errors
/// Fails like [`Capture::load`], and if a photo has fewer than [`MIN_SIDE`] pixels along a side, before any is read.
pub(crate) fn read_in_batches(
    capture: &Capture,
    indices: &[usize],
    size: PhotoSize,
    mut should_continue: impl FnMut(usize) -> bool,
    mut use_views: impl FnMut(Vec<View>),
) -> Result<bool> {
    let cameras = capture.cameras();
    for &index in indices {
        let ImageSize { width, height } = size.of(&cameras[index]);
        if width.min(height) < MIN_SIDE {
            let field = format!("the size of {}", capture.names().nth(index).unwrap_or_default());
            let expected = format!("{MIN_SIDE} pixels or more along each side");
            return Err(Error::input(capture.file(), field, format!("{width}×{height}"), expected));
        }
    }
    let size_of = |index: usize| size.resized(&cameras[index]);
    for (batch, some) in indices.chunks(READ_AT_ONCE).enumerate() {
        if !should_continue(batch * READ_AT_ONCE) {
            return Ok(false);
        }
        // Photos of one size are loaded together, as they share the lens undistortion.
        for group in some.chunk_by(|&a, &b| size_of(a) == size_of(b)) {
            use_views(load_views(capture, group, size_of(group[0]))?);
        }
    }
    Ok(true)
}

/// Reads the views `indices` of `capture` like [`Capture::load`], fitted to `size`, or at their own size if it is `None`.
///
/// # Errors
/// Fails like [`Capture::load`].
pub fn load_views(capture: &Capture, indices: &[usize], size: Option<ImageSize>) -> Result<Vec<View>> {
    Ok(capture.load(indices, size)?.into_par_iter().map(View::from).collect())
}

/// Reads every view of `capture` like [`load_views`].
///
/// # Errors
/// Fails like [`Capture::load`].
pub fn load_all_views(capture: &Capture, size: Option<ImageSize>) -> Result<Vec<View>> {
    load_views(capture, &(0..capture.len()).collect::<Vec<_>>(), size)
}

/// Converts an image to a tensor of 8-bit levels, `[3, H, W]`.
fn byte_tensor(planes: &Planes) -> Tensor {
    let (height, width) = planes.size();
    Tensor::from_slice(planes.as_bytes()).view([CHANNELS as i64, height as i64, width as i64])
}

/// Converts an image to a float tensor, `[3, H, W]`, values in [0, 1].
pub fn tensor_from_planes(planes: &Planes) -> Tensor {
    Pixels::from(byte_tensor(planes)).to_float()
}

/// Side in pixels of the views of [`wall`].
#[cfg(test)]
pub(crate) const WALL_SIDE: i64 = 64;

/// Returns the view of a camera at `x` on a wall with a wave pattern at depth 4.
#[cfg(test)]
pub(crate) fn wall(x: f64) -> View {
    use crate::scene::Intrinsics;
    use glam::{DMat4, DVec3};
    let side = WALL_SIDE as f64;
    let axis = |offset: f64| {
        (Tensor::arange(WALL_SIDE, (Kind::Float, Device::Cpu)) + 0.5 - side / 2.) / side * 4. + offset
    };
    let (u, v) = (axis(x).view([1, WALL_SIDE]), axis(0.).view([WALL_SIDE, 1]));
    let wave = ((&u * 5.).sin() * (&v * 4.).cos() + (&u * 11. + &v * 7.).sin()) * 0.2 + 0.4;
    let intrinsics = Intrinsics { fx: side, fy: side, cx: side / 2., cy: side / 2. };
    let c2w = DMat4::from_translation(DVec3::X * x);
    let camera = Camera { intrinsics, c2w, width: WALL_SIDE as u32, height: WALL_SIDE as u32 };
    let image = wave.expand([3, WALL_SIDE, WALL_SIDE], false).contiguous();
    View { name: x.to_string(), image: image.into(), mask: None, camera }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_become_the_floats_they_stand_for() {
        let levels = Tensor::arange(256, (Kind::Uint8, Device::Cpu)).view([1, 16, 16]);
        let floats = Pixels::from(levels.shallow_clone()).to_float();
        assert_eq!((floats.kind(), floats.double_value(&[0, 15, 15])), (Kind::Float, 1.));
        assert!(Pixels::from(floats.shallow_clone()).to_float().equal(&floats));
        let mut rounded = Pixels::from(levels.zeros_like());
        rounded.copy_from_floats(&(floats + 0.4 / 255.));
        assert!(rounded.0.equal(&levels));
        let floats = rounded.to_float();
        let mixed = Pixels::from(floats.shallow_clone());
        for images in [[&rounded, &rounded], [&rounded, &mixed]] {
            assert!(Pixels::stack(&images).equal(&Tensor::stack(&[&floats, &floats], 0)));
        }
    }
}
