//! Colors for depth that people can compare: equal steps look equally large.

use super::SplatRenderer;
use crate::error::Result;
use crate::scene::{Camera, ImageSize};
use tch::{Kind, Tensor};

/// Minimum opacity at which depth is valid.
const MIN_ALPHA: f64 = 0.05;

/// Smallest divisor, which replaces depths and ranges of 0. It is so small that colors don't depend on the unit.
const SMALLEST: f64 = f32::MIN_POSITIVE as f64;

/// Color map from far to near, matplotlib's viridis: dark violet, blue, green, yellow. Its lightness grows in the most even steps among
/// the well-known color maps, so it reads the same in gray and for the color-blind. Far depths aren't black, which is the color of empty
/// pixels.
const COLORS: colorous::Gradient = colorous::VIRIDIS;
/// Number of colors: as many as the gradient has, and as an 8-bit image distinguishes.
const STEPS: usize = 256;

/// Range of depths that the colors cover. One scale for all frames of a video prevents flicker.
#[derive(Debug, Clone, Copy)]
pub struct DepthScale {
    /// Inverse depth, 1/depth, of the darkest color.
    far: f64,
    /// Inverse depth, 1/depth, of the brightest color.
    near: f64,
}

impl DepthScale {
    /// Computes the scale from the 2nd to the 98th percentile of inverse depth in all `images`, each a depth and its opacity, [H, W].
    pub fn from_depths(images: &[(&Tensor, &Tensor)]) -> Self {
        /// Number of pixels that suffices for percentiles; libtorch sorts at most 2²⁴ values.
        const ENOUGH: i64 = 1 << 20;
        let inverses =
            |&(depth, alpha): &(&Tensor, &Tensor)| inverse(depth).masked_select(&visible_mask(depth, alpha));
        let values = Tensor::cat(&images.iter().map(inverses).collect::<Vec<_>>(), 0);
        if values.numel() == 0 {
            return DepthScale { far: 0., near: 0. };
        }
        let values = values.slice(0, None, None, 1 + values.size()[0] / ENOUGH);
        let bound = |q: f64| values.quantile_scalar(q, None::<i64>, false, "linear").double_value(&[]);
        DepthScale { far: bound(0.02), near: bound(0.98) }
    }

    /// Estimates the scale for renders of a splat from `cameras` by a few small renders, so that it is known before the first image.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn estimate(renderer: &SplatRenderer, cameras: &[Camera]) -> Result<Self> {
        const FEW: usize = 12;
        const SMALL: u32 = 128;
        let small = |camera: &Camera| {
            let by = (camera.width.max(camera.height)).div_ceil(SMALL);
            camera
                .with_size(ImageSize { width: camera.width.div_ceil(by), height: camera.height.div_ceil(by) })
        };
        let count = cameras.len().min(FEW);
        let spread = (0..count).map(|i| small(&cameras[i * (cameras.len() - 1) / (count - 1).max(1)]));
        let rendered = renderer.render(&spread.collect::<Vec<_>>())?;
        Ok(DepthScale::from_depths(&rendered.iter().map(|r| (&r.depth, &r.alpha)).collect::<Vec<_>>()))
    }

    /// Converts depth [H, W] to colors [3, H, W]: near is bright, far is dark, linear in inverse depth. Where little is visible (`alpha`),
    /// the color fades to black.
    pub fn colorize(&self, depth: &Tensor, alpha: &Tensor) -> Tensor {
        let share = (inverse(depth) - self.far) / (self.near - self.far).max(SMALLEST);
        let step = (share.clamp(0., 1.) * (STEPS - 1) as f64).round().to_kind(Kind::Int64);
        let colors = Tensor::from_slice2(&depth_colors()).to_device(depth.device());
        let (height, width) = (depth.size()[0], depth.size()[1]);
        let image = colors.index_select(0, &step.flatten(0, -1)).view([height, width, 3]).permute([2, 0, 1]);
        image * visible_mask(depth, alpha).to_kind(Kind::Float) * alpha.clamp(0., 1.)
    }
}

/// Converts depth to colors like [`DepthScale::colorize`], on the scale of this image.
pub fn colorize_depth(depth: &Tensor, alpha: &Tensor) -> Tensor {
    DepthScale::from_depths(&[(depth, alpha)]).colorize(depth, alpha)
}

fn inverse(depth: &Tensor) -> Tensor {
    depth.clamp_min(SMALLEST).reciprocal()
}

fn visible_mask(depth: &Tensor, alpha: &Tensor) -> Tensor {
    alpha.ge(MIN_ALPHA).logical_and(&depth.gt(0.))
}

/// Returns the color map as RGB in [0, 1], from far to near.
pub fn depth_colors() -> [[f32; 3]; STEPS] {
    std::array::from_fn(|step| {
        let colorous::Color { r, g, b } = COLORS.eval_rational(step, STEPS);
        [r, g, b].map(|value| f32::from(value) / 255.)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_pixels_are_bright_and_transparent_ones_black() {
        let depth = Tensor::from_slice(&[1f32, 2., 4., 0., 1.]).view([1, 5]);
        let alpha = Tensor::from_slice(&[1f32, 1., 1., 1., 0.01]).view([1, 5]);
        let image = colorize_depth(&depth, &alpha);
        assert_eq!(image.size(), [3, 1, 5]);
        let at =
            |x: i64| <[f32; 3]>::try_from(Vec::try_from(image.select(2, x).flatten(0, -1)).unwrap()).unwrap();
        let all = depth_colors();
        assert_eq!((at(0), at(2)), (all[STEPS - 1], all[0]));
        assert_eq!((at(3), at(4)), ([0.; 3], [0.; 3]));
    }

    #[test]
    fn one_scale_gives_one_depth_one_color() {
        let opaque = Tensor::ones([1, 2], (Kind::Float, tch::Device::Cpu));
        let [first, second] = [[1f32, 2.], [2., 8.]].map(|depths| Tensor::from_slice(&depths).view([1, 2]));
        let scale = DepthScale::from_depths(&[(&first, &opaque), (&second, &opaque)]);
        let two = |image: &Tensor, x: i64| scale.colorize(image, &opaque).select(2, x);
        assert_eq!(two(&first, 1), two(&second, 0));
        // On scales of their own, a depth of 2 is the farthest in one image and the nearest in the other.
        assert_ne!(
            colorize_depth(&first, &opaque).select(2, 1),
            colorize_depth(&second, &opaque).select(2, 0)
        );
        // If nothing is visible, the image is black.
        let nothing = opaque.zeros_like();
        assert_eq!(colorize_depth(&first, &nothing).sum(Kind::Float).double_value(&[]), 0.);
    }
}
