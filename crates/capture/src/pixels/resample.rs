//! Antialiased Lanczos resampling that reproduces Pillow, which the published evaluations use for resizing (spec 9.3).
//!
//! Pillow filters along rows first, rounds to 8 bits, and then filters along columns. The order matters in saturated images: the
//! filters overshoot, and values out of range are clamped after each pass, so that the opposite order differs by up to 41 levels.
//! With Pillow's order and weights in float32, the results differ from Pillow's by at most one level, in one of ten thousand
//! values.
//!
//! The first pass filters eight rows at once, with a lane for each row and channel, so that the compiler can vectorize every
//! multiplication for any instruction set. It writes planes, which the second pass reads row by row.

use super::planes::{CHANNELS, split_channels};
use crate::geometry::ImageSize;
use image::RgbImage;
use std::f64::consts::PI;
use std::ops::Range;

/// Number of lobes on each side of the filter's center.
const LOBES: f64 = 3.;
/// Number of rows that the first pass filters at once.
const ROWS: usize = 8;
/// Number of values that the first pass filters at once: a column of pixels, channel by channel.
const LANES: usize = CHANNELS * ROWS;

/// A rectangle of an image, in pixels from the image's corner. Its edges may lie inside pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// Position of the left edge.
    pub left: f64,
    /// Position of the upper edge.
    pub top: f64,
    /// Width, above 0.
    pub width: f64,
    /// Height, above 0.
    pub height: f64,
}

impl Region {
    /// Returns the region of a whole image.
    pub(super) fn whole(image: &RgbImage) -> Self {
        Region { left: 0., top: 0., width: f64::from(image.width()), height: f64::from(image.height()) }
    }
}

/// Filter taps along one axis: the inputs that contribute to each output, and their weights.
#[derive(Debug, Clone, PartialEq)]
struct Taps {
    /// Input size, start and extent of the region, output size.
    key: (usize, f64, f64, usize),
    /// Index of the first input of each output.
    first: Vec<usize>,
    /// Number of inputs of each output, some of them with weight 0.
    count: usize,
    /// Weights, `[outputs, count]`.
    weights: Vec<f32>,
}

impl Taps {
    fn new(key: (usize, f64, f64, usize)) -> Self {
        let (inputs, start, extent, outputs) = key;
        let scale = extent / outputs as f64;
        // The filter interpolates when it enlarges. When it reduces, it is stretched to cover as many inputs as an output does.
        let stretch = scale.max(1.);
        let support = LOBES * stretch;
        let count = ((2. * support).ceil() as usize + 1).min(inputs);
        let mut first = Vec::with_capacity(outputs);
        let mut weights = vec![0f32; outputs * count];
        for (output, weights) in weights.chunks_exact_mut(count).enumerate() {
            let center = start + (output as f64 + 0.5) * scale;
            let low = ((center - support + 0.5).max(0.) as usize).min(inputs - 1);
            let high = ((center + support + 0.5) as usize).clamp(low + 1, inputs).min(low + count);
            let raw = |input: usize| lanczos((input as f64 + 0.5 - center) / stretch);
            let sum: f64 = (low..high).map(raw).sum();
            // All windows have `count` inputs. Near the end of the axis they begin earlier, and the additional weights are 0.
            let begin = low.min(inputs - count);
            for input in low..high {
                weights[input - begin] = (raw(input) / sum) as f32;
            }
            first.push(begin);
        }
        Taps { key, first, count, weights }
    }

    /// Returns the range of inputs that any output reads.
    fn range(&self) -> Range<usize> {
        let (first, last) = (self.first.iter().min(), self.first.iter().max());
        *first.expect("an output")..last.expect("an output") + self.count
    }
}

fn lanczos(x: f64) -> f64 {
    let sinc = |x: f64| if x == 0. { 1. } else { (PI * x).sin() / (PI * x) };
    if x.abs() < LOBES { sinc(x) * sinc(x / LOBES) } else { 0. }
}

/// Constant 1.5·2^23. Adding it to a float32 and subtracting it again rounds to an integer, which vectorizes on every instruction set.
const ROUNDING: f32 = 12_582_912.;

/// Rounds `value` to the nearest integer and clamps it to 0 to 255.
fn to_level(value: f32) -> f32 {
    ((value + ROUNDING) - ROUNDING).clamp(0., 255.)
}

/// Resampler for a sequence of images. It keeps taps and buffers for the next image.
#[derive(Debug, Default)]
pub struct Resampler {
    columns: Option<Taps>,
    rows: Option<Taps>,
    /// Eight rows of the image, `[W][3, 8]`.
    tile: Vec<[f32; LANES]>,
    /// Levels after the first pass, `[3, rows, output width]`.
    filtered: Vec<f32>,
}

impl Resampler {
    /// Resamples `region` of `image` to `size` and writes it into `planes`, `[3, H, W]`. Pixels outside the region contribute if
    /// the filter reaches them.
    pub fn resample(&mut self, image: &RgbImage, region: Region, size: ImageSize, planes: &mut [u8]) {
        let (width, height) = (image.width() as usize, image.height() as usize);
        let (out_width, out_height) = (size.width as usize, size.height as usize);
        if region == Region::whole(image) && (width, height) == (out_width, out_height) {
            return split_channels(image, planes);
        }
        let columns = taps(&mut self.columns, (width, region.left, region.width, out_width));
        let rows = taps(&mut self.rows, (height, region.top, region.height, out_height));
        let needed = rows.range();
        let stride = needed.len().next_multiple_of(ROWS);
        self.filtered.resize(CHANNELS * stride * out_width, 0.);
        self.tile.resize(width, [0.; LANES]);
        for from in (0..needed.len()).step_by(ROWS) {
            fill_tile(&mut self.tile, image, columns.range(), needed.start + from);
            let lanes = columns.first.iter().zip(columns.weights.chunks_exact(columns.count));
            for (x, (&first, weights)) in lanes.enumerate() {
                let mut sum = [0f32; LANES];
                for (pixels, &weight) in self.tile[first..][..columns.count].iter().zip(weights) {
                    for (sum, pixel) in sum.iter_mut().zip(pixels) {
                        *sum += pixel * weight;
                    }
                }
                for (lane, &sum) in sum.iter().enumerate() {
                    let (channel, row) = (lane / ROWS, lane % ROWS);
                    self.filtered[(channel * stride + from + row) * out_width + x] = to_level(sum);
                }
            }
        }
        let mut sum = vec![0f32; out_width];
        let filtered = self.filtered.chunks_exact(stride * out_width);
        for (plane, filtered) in planes.chunks_exact_mut(out_width * out_height).zip(filtered) {
            let weights = rows.first.iter().zip(rows.weights.chunks_exact(rows.count));
            for (line, (&first, weights)) in plane.chunks_exact_mut(out_width).zip(weights) {
                sum.fill(0.);
                let inputs = filtered[(first - needed.start) * out_width..].chunks_exact(out_width);
                for (input, &weight) in inputs.zip(weights).filter(|(_, weight)| **weight != 0.) {
                    for (sum, value) in sum.iter_mut().zip(input) {
                        *sum += value * weight;
                    }
                }
                for (byte, &sum) in line.iter_mut().zip(&sum) {
                    // A float32 between 2^23 and 2^24 is an integer, and its lowest byte is that integer modulo 256.
                    *byte = (sum.clamp(0., 255.) + ROUNDING).to_bits() as u8;
                }
            }
        }
    }
}

/// Returns the taps for `key`: the cached ones if their key is equal, which is so for most images, or else new ones.
fn taps(cached: &mut Option<Taps>, key: (usize, f64, f64, usize)) -> &Taps {
    if cached.as_ref().is_none_or(|taps| taps.key != key) {
        *cached = None;
    }
    cached.get_or_insert_with(|| Taps::new(key))
}

/// Returns the range of inputs that the outputs of `key` read.
pub(super) fn source_range(key: (usize, f64, f64, usize)) -> Range<usize> {
    Taps::new(key).range()
}

/// Copies the pixels of [`ROWS`] rows from `top` on, within `columns`, to `tile`. Rows below the image repeat its last row.
fn fill_tile(tile: &mut [[f32; LANES]], image: &RgbImage, columns: Range<usize>, top: usize) {
    let (width, height) = (image.width() as usize, image.height() as usize);
    for row in 0..ROWS {
        let start = (top + row).min(height - 1) * width;
        let pixels = &image.as_raw()[(start + columns.start) * CHANNELS..(start + columns.end) * CHANNELS];
        for (lanes, pixel) in tile[columns.clone()].iter_mut().zip(pixels.chunks_exact(CHANNELS)) {
            for (channel, &byte) in pixel.iter().enumerate() {
                lanes[channel * ROWS + row] = f32::from(byte);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::planes::Planes;
    use super::*;
    use image::Rgb;
    use image::imageops::{self, FilterType};

    fn resample(image: &RgbImage, region: Region, size: [u32; 2]) -> RgbImage {
        let size = ImageSize::from(size);
        let mut planes = Planes::new(size.width, size.height);
        Resampler::default().resample(image, region, size, planes.bytes_mut());
        planes.to_rgb()
    }

    /// Test image with levels from 64 to 191, so that no overshoot is clamped.
    fn waves(width: u32, height: u32) -> RgbImage {
        RgbImage::from_fn(width, height, |x, y| {
            let wave = |step: u32| 127.5 + 63. * (f64::from(x * step + y * (7 - step)) * 0.13).sin();
            Rgb([1, 3, 6].map(|step| wave(step) as u8))
        })
    }

    #[test]
    fn results_match_the_image_crate() {
        // Taps of one image don't affect the next.
        let mut resampler = Resampler::default();
        for ([width, height], size) in [
            ([64, 36], [26, 46]),
            ([41, 37], [36, 40]),
            ([64, 36], [26, 46]),
            ([20, 11], [33, 50]),
            ([9, 9], [2, 3]),
            ([5, 3], [1, 1]),
            ([13, 9], [9, 13]),
        ] {
            let (image, size) = (waves(width, height), ImageSize::from(size));
            let mut planes = Planes::new(size.width, size.height);
            resampler.resample(&image, Region::whole(&image), size, planes.bytes_mut());
            let theirs = imageops::resize(&image, size.width, size.height, FilterType::Lanczos3);
            // The image crate doesn't round between its passes, so that levels may differ by one.
            let ours = planes.to_rgb();
            let difference = ours.as_raw().iter().zip(theirs.as_raw()).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(difference <= Some(1), "{width}×{height} to {size:?}: {difference:?}");
        }
        let image = waves(13, 9);
        assert_eq!(resample(&image, Region::whole(&image), [9, 13]), image, "an image of the size is copied");
    }

    #[test]
    fn a_resampled_region_equals_a_crop_of_the_resampled_image() {
        let image = waves(64, 48);
        let half = resample(&image, Region::whole(&image), [24, 32]);
        let region = Region { left: 10., top: 6., width: 40., height: 24. };
        let crop = imageops::crop_imm(&half, 5, 3, 20, 12).to_image();
        assert_eq!(resample(&image, region, [12, 20]), crop);
    }
}
