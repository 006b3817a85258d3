//! Pixels of a photo in memory.

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
