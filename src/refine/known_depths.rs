//! Loss between rendered depths and those that the plane sweep has found.

use crate::scene::Camera;
use crate::stereo::DepthMap;
use tch::{Device, Kind, Tensor};

/// Relative difference from which a depth pulls no more: either it is wrong, or the pixel shows something that the depth doesn't belong to.
const MAX_DIFFERENCE: f64 = 0.5;

/// Depths of a photo at pixels on which the photos agree.
#[derive(Debug)]
pub(super) struct KnownDepths {
    /// Indices of the pixels in the photo, row by row, [K].
    pixels: Tensor,
    /// Their depths, [K].
    depths: Tensor,
    /// Fraction of the compared pixels that these are.
    share: f64,
}

impl KnownDepths {
    /// Returns the depths of `map` on which the photos agree, at the pixels of the photo of `camera` in which the centers of the map's
    /// pixels are. If the photo has fewer pixels, each gets one of the depths.
    pub fn new(map: &DepthMap, camera: &Camera, device: Device) -> Self {
        let (width, height) = (i64::from(camera.width), i64::from(camera.height));
        let size = map.depth.size();
        // The pixel of the photo, along one side, in which the center of each of the map's pixels is.
        let along = |count: i64, side: i64| -> Vec<i64> {
            (0..count).map(|i| ((i as f64 + 0.5) * side as f64 / count as f64) as i64).collect()
        };
        let (rows, columns) = (along(size[0], height), along(size[1], width));
        let is_first = |along: &[i64], i: usize| i == 0 || along[i] != along[i - 1];
        let (depth, sure, counted) = (map.depths(), map.sure_pixels(), map.counted_pixels());
        let (mut pixels, mut depths, mut all) = (vec![], vec![], 0);
        for (y, &row) in rows.iter().enumerate().filter(|&(y, _)| is_first(&rows, y)) {
            for (x, &column) in columns.iter().enumerate().filter(|&(x, _)| is_first(&columns, x)) {
                let at = y * columns.len() + x;
                all += 1;
                if sure[at] && counted.as_ref().is_none_or(|counted| counted[at]) {
                    pixels.push(row * width + column);
                    depths.push(depth[at]);
                }
            }
        }
        KnownDepths {
            share: pixels.len() as f64 / f64::from(all),
            pixels: Tensor::from_slice(&pixels).to_device(device),
            depths: Tensor::from_slice(&depths).to_device(device),
        }
    }

    /// Returns the mean over the compared pixels of 2 |a − b| / (a + b) for rendered depths `rendered` [H, W] a and known ones b, limited to
    /// [`MAX_DIFFERENCE`] and counted as 0 where no depth is known. Differentiable with respect to the rendered depths in the numerator.
    pub fn loss(&self, rendered: &Tensor) -> Tensor {
        let rendered = rendered.reshape([-1]).index_select(0, &self.pixels);
        let difference = (&rendered - &self.depths).abs() / (rendered.detach() + &self.depths) * 2.;
        difference.clamp_max(MAX_DIFFERENCE).sum(Kind::Float)
            * (self.share / self.pixels.numel().max(1) as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the known depths of a photo of `width`×`height`, by a map of 2×2 pixels at depths 1 to 4, of which the last isn't sure and the
    /// first doesn't count.
    fn known(width: u32, height: u32) -> KnownDepths {
        let truths = |values: [bool; 4]| Tensor::from_slice(&values).view([2, 2]);
        let map = DepthMap {
            depth: Tensor::from_slice(&[1f32, 2., 3., 4.]).view([2, 2]),
            sure: truths([true, true, true, false]),
            counted: Some(truths([false, true, true, true])),
            ..DepthMap::flat(2, 2, 1.)
        };
        KnownDepths::new(&map, &Camera { width, height, ..map.camera }, Device::Cpu)
    }

    #[test]
    fn sure_depths_pull_where_their_pixels_are() {
        let known = known(6, 4);
        // In a photo of 6×4 pixels the centers of the map's pixels are in columns 1 and 4, and in rows 1 and 3.
        let rendered = Tensor::full([4, 6], 9., (Kind::Float, Device::Cpu));
        let put = |row: i64, column: i64, depth: f64| {
            let _ = rendered.get(row).get(column).fill_(depth);
        };
        put(1, 4, 2.5);
        put(3, 1, 3.);
        let rendered = rendered.set_requires_grad(true);
        let loss = known.loss(&rendered);
        loss.backward();
        // 2 · 0.5 / 4.5 at one of the map's four pixels, 0 at another, and none at the others.
        assert!((loss.double_value(&[]) - 2. * 0.5 / 4.5 / 4.).abs() < 1e-6);
        let gradient = rendered.grad();
        assert!((gradient.double_value(&[1, 4]) - 2. / 4.5 / 4.).abs() < 1e-6);
        assert_eq!(gradient.abs().sum(Kind::Double).double_value(&[]), gradient.double_value(&[1, 4]));
    }

    #[test]
    fn each_pixel_of_a_small_photo_gets_one_depth() {
        let known = known(1, 2);
        // The first column has depths 1, which doesn't count, and 3.
        assert_eq!((Vec::<i64>::try_from(&known.pixels).unwrap(), known.share), (vec![1], 0.5));
        assert_eq!(known.depths.double_value(&[0]), 3.);
    }

    #[test]
    fn depths_that_are_far_off_pull_nothing() {
        let known = known(2, 2);
        let rendered = Tensor::full([2, 2], 30., (Kind::Float, Device::Cpu)).set_requires_grad(true);
        let loss = known.loss(&rendered);
        loss.backward();
        // Two of four pixels at the limit.
        assert!((loss.double_value(&[]) - MAX_DIFFERENCE / 2.).abs() < 1e-6);
        assert_eq!(rendered.grad().abs().sum(Kind::Double).double_value(&[]), 0.);
    }
}
