//! Mosaics: images that are added one at a time and tiled side by side, or one below the other, into a single image.

use super::images::{rgb_from_tensor, shrink, tile_horizontally, tile_images, write_image};
use crate::error::Result;
use image::RgbImage;
use std::path::Path;
use tch::Tensor;

/// Maximum number of pixels of a mosaic, chosen so that common programs can open it and people can view it.
const MAX_PIXELS: i64 = 1 << 26;

/// Images that are tiled into one, stored as 8 bits until then. If they have more pixels together than programs open, each is shrunk by an
/// integer factor.
#[derive(Debug)]
pub struct Mosaic {
    is_column: bool,
    /// Maximum number of pixels of each image.
    most_pixels: i64,
    images: Vec<RgbImage>,
    shrunk_by: i64,
}

impl Mosaic {
    /// Creates a mosaic for a row of `count` images.
    pub fn row(count: usize) -> Self {
        let most_pixels = MAX_PIXELS / count.max(1) as i64;
        Mosaic { is_column: false, most_pixels, images: vec![], shrunk_by: 1 }
    }

    /// Creates a mosaic for a column of `count` images.
    pub fn column(count: usize) -> Self {
        Mosaic { is_column: true, ..Mosaic::row(count) }
    }

    /// Adds an image that consists of `parts` side by side, each [3, H, W] in [0, 1] and all of the same size.
    ///
    /// # Errors
    /// Returns libtorch's error, for example for another shape.
    pub fn add(&mut self, parts: &[Tensor]) -> Result<()> {
        let factor = self.factor(parts.len(), &parts[0]);
        let parts: Vec<Tensor> = parts.iter().map(|part| shrink(part, factor)).collect();
        self.add_shrunk(&parts)
    }

    /// Returns the factor by which to divide the sides of an image that consists of `parts` tensors, each of the size of `part` [.., H, W].
    pub fn factor(&mut self, parts: usize, part: &Tensor) -> i64 {
        let [.., height, width] = part.size()[..] else { panic!("an image has height and width") };
        let factor = shrink_factor(parts as i64 * height * width, self.most_pixels);
        self.shrunk_by = self.shrunk_by.max(factor);
        factor
    }

    /// Adds an image like [`Mosaic::add`], from parts that [`Mosaic::factor`] has already shrunk.
    ///
    /// # Errors
    /// Returns libtorch's error, for example for another shape.
    pub fn add_shrunk(&mut self, parts: &[Tensor]) -> Result<()> {
        self.images.push(rgb_from_tensor(&tile_horizontally(parts))?);
        Ok(())
    }

    /// Returns the largest factor by which the sides of an image were divided: 1 if nothing was shrunk.
    pub fn shrunk_by(&self) -> i64 {
        self.shrunk_by
    }

    /// Writes the mosaic as a PNG.
    ///
    /// # Errors
    /// Returns an error if the file can't be written.
    pub fn write(self, path: &Path) -> Result<()> {
        write_image(path, &tile_images(&self.images, self.is_column), false)
    }
}

/// Returns the smallest integer by which both sides must be divided so that at most `most` of `pixels` remain.
pub fn shrink_factor(pixels: i64, most: i64) -> i64 {
    (1..).find(|factor| pixels <= most.max(1) * factor * factor).expect("a whole number")
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::{Device, Kind};

    #[test]
    fn many_large_pictures_are_shrunk_and_few_are_not() {
        let image = Tensor::ones([3, 64, 96], (Kind::Float, Device::Cpu)) * 0.5;
        for (count, most, size, by) in [(2, 1 << 26, [64, 196], 1), (2, 2 * 64 * 96 / 4, [32, 100], 2)] {
            let mut mosaic = Mosaic { most_pixels: most / count, ..Mosaic::row(2) };
            for _ in 0..count {
                mosaic.add(std::slice::from_ref(&image)).unwrap();
            }
            assert_eq!(mosaic.shrunk_by(), by);
            let file = tempfile::NamedTempFile::with_suffix(".png").unwrap();
            mosaic.write(file.path()).unwrap();
            let image = crate::io::read_image(file.path()).unwrap();
            assert_eq!([image.height(), image.width()], size);
            assert_eq!((image.get_pixel(0, 0).0, image.get_pixel(size[1] - 1, 0).0), ([128; 3], [128; 3]));
        }
        assert_eq!(shrink_factor(16_000_000 * 3, MAX_PIXELS / 300), 15);
    }
}
