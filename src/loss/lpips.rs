//! LPIPS, a perceptual image distance: Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", 2018,
//! equation 1. It uses version 0.1 of the linear weights, as published results do.

use crate::device::disable_tf32;
use crate::error::Result;
use crate::io::WeightsFile;
use crate::model::{Precision, convolve};
use std::path::Path;
use tch::{Device, Kind, Tensor, nn};

/// Values subtracted from images in [−1, 1], per channel: the mean of the photos that the networks were trained on. `SCALE`, their standard
/// deviation, is the divisor.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Constant added to the norms that features are divided by.
const EPSILON: f64 = 1e-10;
/// Maximum number of pixels of an image that is compared as a whole. Larger images are compared in tiles: VGG-16's first features take 256
/// bytes per pixel, several times over.
const MAX_PIXELS: i64 = 1 << 20;
/// Approximate side of a tile in pixels.
const TILE: i64 = 640;
/// Upper bound on the number of pixels beyond a tile that its features depend on: 90 for VGG-16 and 80 for AlexNet, rounded up to a
/// multiple of [`LARGEST_STRIDE`].
const HALO: i64 = 96;
/// Stride of the last layer's features in pixels, for either network. The stride of every other layer divides it.
const LARGEST_STRIDE: i64 = 16;

/// Backbone whose features LPIPS compares.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LpipsNetwork {
    /// VGG-16 (Simonyan & Zisserman 2015), with features after ReLU 1_2, 2_2, 3_3, 4_3 and 5_3.
    Vgg16,
    /// AlexNet in its one-tower form (Krizhevsky 2014), with features after each of the five ReLUs.
    AlexNet,
}

/// Convolution with its ReLU, an optional pooling before it, and an optional comparison after it.
struct Layer {
    name: &'static str,
    channels: i64,
    kernel: i64,
    stride: i64,
    padding: i64,
    /// Preceded by a max pooling.
    pooled: bool,
    /// Included in the distance.
    compared: bool,
}

impl LpipsNetwork {
    /// All networks that can compute LPIPS.
    pub const ALL: [LpipsNetwork; 2] = [LpipsNetwork::Vgg16, LpipsNetwork::AlexNet];

    /// Returns the name of the metric in reports.
    pub fn metric(self) -> &'static str {
        match self {
            LpipsNetwork::Vgg16 => "lpips_vgg",
            LpipsNetwork::AlexNet => "lpips_alex",
        }
    }

    /// Returns the file name that `make weights` gives to the weights.
    pub fn file_name(self) -> &'static str {
        match self {
            LpipsNetwork::Vgg16 => "lpips_vgg.safetensors",
            LpipsNetwork::AlexNet => "lpips_alex.safetensors",
        }
    }

    /// Returns the smallest side of an image in pixels. In a smaller image the last layer would have no features.
    pub fn smallest_side(self) -> i64 {
        match self {
            LpipsNetwork::Vgg16 => 16,
            LpipsNetwork::AlexNet => 31,
        }
    }

    /// Returns the stride in pixels of the features of every layer that is compared.
    fn strides(self) -> Vec<i64> {
        let mut stride = 1;
        let layers = self.layers().into_iter().filter_map(|layer| {
            stride *= layer.stride * if layer.pooled { 2 } else { 1 };
            layer.compared.then_some(stride)
        });
        layers.collect()
    }

    /// Returns the side of the max poolings' windows, whose stride is 2.
    fn pool(self) -> i64 {
        match self {
            LpipsNetwork::Vgg16 => 2,
            LpipsNetwork::AlexNet => 3,
        }
    }

    fn layers(self) -> Vec<Layer> {
        match self {
            LpipsNetwork::Vgg16 => {
                let layer = |name, channels, pooled, compared| {
                    let (kernel, stride, padding) = (3, 1, 1);
                    Layer { name, channels, kernel, stride, padding, pooled, compared }
                };
                vec![
                    layer("conv1_1", 64, false, false),
                    layer("conv1_2", 64, false, true),
                    layer("conv2_1", 128, true, false),
                    layer("conv2_2", 128, false, true),
                    layer("conv3_1", 256, true, false),
                    layer("conv3_2", 256, false, false),
                    layer("conv3_3", 256, false, true),
                    layer("conv4_1", 512, true, false),
                    layer("conv4_2", 512, false, false),
                    layer("conv4_3", 512, false, true),
                    layer("conv5_1", 512, true, false),
                    layer("conv5_2", 512, false, false),
                    layer("conv5_3", 512, false, true),
                ]
            }
            LpipsNetwork::AlexNet => {
                let layer = |name, channels, [kernel, stride, padding]: [i64; 3], pooled| {
                    let compared = true;
                    Layer { name, channels, kernel, stride, padding, pooled, compared }
                };
                vec![
                    layer("conv1", 64, [11, 4, 2], false),
                    layer("conv2", 192, [5, 1, 2], true),
                    layer("conv3", 384, [3, 1, 1], true),
                    layer("conv4", 256, [3, 1, 1], false),
                    layer("conv5", 256, [3, 1, 1], false),
                ]
            }
        }
    }
}

/// Extent of a tile along one side of an image, in pixels.
#[derive(Debug, Clone, Copy)]
struct Tile {
    /// First pixel of the tile, a multiple of [`LARGEST_STRIDE`].
    first: i64,
    /// End of the tile: the pixel after its last.
    end: i64,
    /// First pixel of the network's input.
    input_start: i64,
    /// End of the network's input: the pixel after its last.
    input_end: i64,
}

impl Tile {
    /// Divides `side` pixels into tiles of about `length` pixels.
    fn split(side: i64, length: i64) -> impl Iterator<Item = Tile> + Clone {
        let count = (side + length - 1) / length;
        let step = (side / count / LARGEST_STRIDE + 1) * LARGEST_STRIDE;
        (0..side).step_by(step as usize).map(move |first| {
            let end = (first + step).min(side);
            Tile { first, end, input_start: (first - HALO).max(0), input_end: (end + HALO).min(side) }
        })
    }

    /// Returns the network's input for this tile: a slice of `images` along `dim`.
    fn slice_input(self, images: &Tensor, dim: i64) -> Tensor {
        images.narrow(dim, self.input_start, self.input_end - self.input_start)
    }

    /// Returns the tile's own values of `features`, whose stride along `dim` is `stride` pixels. At the end of the image a layer may have
    /// fewer features than the pixels and the stride suggest.
    fn slice_features(self, features: &Tensor, dim: i64, stride: i64) -> Tensor {
        let there = features.size()[dim as usize];
        let first = ((self.first - self.input_start) / stride).min(there);
        let is_last = self.end == self.input_end;
        let count = if is_last { there } else { (self.end - self.first) / stride };
        features.narrow(dim, first, count.min(there - first))
    }
}

/// LPIPS distance, differentiable; in float32 by default.
#[derive(Debug)]
pub struct Lpips {
    network: LpipsNetwork,
    /// Precision of the convolutions; features are normalized and compared in that of the weights, float32.
    precision: Precision,
    /// Shift of the input, [1, 3, 1, 1].
    shift: Tensor,
    /// Divisor of the input, [1, 3, 1, 1].
    scale: Tensor,
    steps: Vec<Step>,
}

/// A [`Layer`] with its weights.
#[derive(Debug)]
struct Step {
    pooled: bool,
    convolution: nn::Conv2D,
    /// Weights of the squared differences in each channel, [1, C, 1, 1]; `None` if the features aren't compared.
    linear: Option<Tensor>,
}

impl Lpips {
    /// Builds the network under `vs`: `conv….weight` [O, I, k, k] and `.bias` [O], `lin0.weight` to `lin4.weight` [1, C, 1, 1]. They are
    /// zero until they are loaded.
    pub(crate) fn new(vs: &nn::Path, network: LpipsNetwork) -> Self {
        disable_tf32();
        let zero = nn::Init::Const(0.);
        let (mut inputs, mut compared, mut steps) = (3, 0, vec![]);
        for layer in network.layers() {
            let config = nn::ConvConfig {
                stride: layer.stride,
                padding: layer.padding,
                ws_init: zero,
                bs_init: zero,
                ..Default::default()
            };
            let convolution = nn::conv2d(vs / layer.name, inputs, layer.channels, layer.kernel, config);
            let linear = layer.compared.then(|| {
                compared += 1;
                (vs / format!("lin{}", compared - 1)).var("weight", &[1, layer.channels, 1, 1], zero)
            });
            steps.push(Step { pooled: layer.pooled, convolution, linear });
            inputs = layer.channels;
        }
        let per_channel =
            |values: &[f32]| Tensor::from_slice(values).view([1, 3, 1, 1]).to_device(vs.device());
        let precision = Precision::default();
        Lpips { network, precision, shift: per_channel(&SHIFT), scale: per_channel(&SCALE), steps }
    }

    /// Loads the weights that `make weights` creates. They need no gradient; images may.
    ///
    /// # Errors
    /// Returns an error if the file can't be read or holds another network.
    pub fn load(path: &Path, network: LpipsNetwork, device: Device) -> Result<Self> {
        let mut vs = nn::VarStore::new(device);
        let lpips = Lpips::new(&vs.root(), network);
        WeightsFile::open(path)?.load_into(&vs)?;
        vs.freeze();
        Ok(lpips)
    }

    /// Converts the network, whose weights are loaded, to `precision`.
    pub fn with_precision(mut self, precision: Precision) -> Self {
        self.steps.iter_mut().for_each(|step| precision.convert(&mut step.convolution));
        Lpips { precision, ..self }
    }

    /// Returns the network whose features are compared.
    pub fn network(&self) -> LpipsNetwork {
        self.network
    }

    /// Returns the device of the weights, on which images must be, too.
    pub fn device(&self) -> Device {
        self.shift.device()
    }

    /// Computes the LPIPS distance of two images: 0 for equal ones. Both are […, 3, H, W] in [0, 1], float32, H and W at least
    /// [`LpipsNetwork::smallest_side`]; the result is […]. Large images are processed in tiles that overlap by the network's receptive
    /// field, so the result is that for the whole image except for the order of sums.
    ///
    /// # Panics
    /// Panics if the images have another shape or a smaller size.
    pub fn distance(&self, image: &Tensor, ground_truth: &Tensor) -> Tensor {
        let size = image.size();
        let [.., height, width] = size[..] else { panic!("an image has shape {size:?}") };
        let distance = match height * width <= MAX_PIXELS {
            true => self.compare(self.features(image), self.features(ground_truth)),
            false => self.distance_in_tiles(image, ground_truth, TILE),
        };
        distance.view(&size[..size.len() - 3])
    }

    /// Computes [`Lpips::distance`] of B images, `[B]`, in tiles with sides of about `length` pixels.
    fn distance_in_tiles(&self, image: &Tensor, ground_truth: &Tensor, length: i64) -> Tensor {
        let [.., height, width] = image.size()[..] else { panic!("an image has height and width") };
        let columns = Tile::split(width, length);
        let tiles =
            Tile::split(height, length).flat_map(|row| columns.clone().map(move |column| (row, column)));
        let strides = self.network.strides();
        // For every layer: the sum over pixels, [B], and the number of pixels.
        let mut sums: Vec<Option<(Tensor, i64)>> = strides.iter().map(|_| None).collect();
        for (row, column) in tiles {
            let cut = |images: &Tensor| {
                let dims = images.dim() as i64;
                column.slice_input(&row.slice_input(images, dims - 2), dims - 1)
            };
            let (image, ground_truth) = (cut(image), cut(ground_truth));
            let differences = self.differences(self.features(&image), self.features(&ground_truth));
            for ((difference, stride), sum) in differences.zip(&strides).zip(&mut sums) {
                let own = column.slice_features(&row.slice_features(&difference, 2, *stride), 3, *stride);
                let count = own.size()[2] * own.size()[3];
                let of_tile = own.sum_dim_intlist([1i64, 2, 3].as_slice(), false, Kind::Double);
                *sum = Some(match sum.take() {
                    Some((sum, counted)) => (sum + of_tile, counted + count),
                    None => (of_tile, count),
                });
            }
        }
        let means = sums.into_iter().flatten().map(|(sum, count)| sum / count as f64);
        means.reduce(|sum, mean| sum + mean).expect("five layers").to_kind(Kind::Float)
    }

    /// Computes the features that [`Lpips::compare`] compares, layer by layer and lazily: [B, C, H', W'], divided by their norm over the
    /// channels. `images` are B images as in [`Lpips::distance`].
    pub fn features(&self, images: &Tensor) -> impl Iterator<Item = Tensor> {
        let size = images.size();
        let images = images.reshape([-1, 3, size[size.len() - 2], size[size.len() - 1]]);
        let mut xs = self.precision.images(&((images * 2. - 1. - &self.shift) / &self.scale));
        self.steps.iter().filter_map(move |step| {
            if step.pooled {
                let pool = self.network.pool();
                xs = xs.max_pool2d([pool, pool], [2, 2], [0, 0], [1, 1], false);
            }
            xs = convolve(&step.convolution, &xs);
            step.linear.as_ref().map(|linear| unit(&xs.to_kind(linear.kind())))
        })
    }

    /// Computes Σ over layers of the mean over pixels of Σ over channels of w (â − b̂)², `[B]`, from the features of two batches of B
    /// images.
    pub fn compare(&self, a: impl Iterator<Item = Tensor>, b: impl Iterator<Item = Tensor>) -> Tensor {
        self.differences(a, b)
            .map(|difference| difference.mean_dim([1i64, 2, 3].as_slice(), false, None::<Kind>))
            .reduce(|sum, distance| sum + distance)
            .expect("five layers")
    }

    /// Computes Σ over channels of w (â − b̂)², layer by layer, [B, 1, H', W'].
    fn differences(
        &self,
        a: impl Iterator<Item = Tensor>,
        b: impl Iterator<Item = Tensor>,
    ) -> impl Iterator<Item = Tensor> {
        let linear = self.steps.iter().filter_map(|step| step.linear.as_ref());
        linear
            .zip(a.zip(b))
            .map(|(linear, (a, b))| (a - b).square().conv2d(linear, None::<&Tensor>, 1, 0, 1, 1))
    }
}

/// Divides features [B, C, H, W] by their norm over C. If all channels are 0 the norm has no derivative, but the preceding ReLU lets no
/// gradient through.
fn unit(features: &Tensor) -> Tensor {
    features / (features.norm_scalaropt_dim(2., [1i64].as_slice(), true) + EPSILON)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiled_distance_matches_the_whole_image() {
        tch::manual_seed(3);
        for network in LpipsNetwork::ALL {
            let vs = nn::VarStore::new(Device::Cpu);
            let lpips = Lpips::new(&vs.root(), network);
            // About half of the features are 0, as in trained networks.
            tch::no_grad(|| {
                for mut variable in vs.variables().into_values() {
                    let inputs = variable.size()[1..].iter().product::<i64>().max(1);
                    let _ = variable.normal_(0., (2. / inputs as f64).sqrt());
                    // Weights of differences must not be negative.
                    if variable.size().first() == Some(&1) {
                        let _ = variable.abs_();
                    }
                }
            });
            assert_eq!(network.strides().last(), Some(&LARGEST_STRIDE));
            // Sides that the strides divide and sides that they don't, including a last tile for which AlexNet has no feature.
            for (height, width) in [(64, 288), (81, 241), (129, 193)] {
                let image = || Tensor::rand([1, 3, height, width], (Kind::Float, Device::Cpu));
                let (a, b) = (image(), image());
                let whole = Vec::<f64>::try_from(lpips.distance(&a, &b).to_kind(Kind::Double)).unwrap();
                let tiled = lpips.distance_in_tiles(&a, &b, 96).to_kind(Kind::Double);
                for (whole, tiled) in whole.into_iter().zip(Vec::<f64>::try_from(tiled).unwrap()) {
                    let error = (whole - tiled).abs() / whole.abs();
                    assert!(error < 1e-5, "{network:?} {height}×{width}: {whole} and {tiled}");
                }
            }
        }
    }
}
