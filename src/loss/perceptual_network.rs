//! Networks trained on photos, in whose features images are compared: VGG-16 and AlexNet for LPIPS (Zhang et al., "The Unreasonable
//! Effectiveness of Deep Features as a Perceptual Metric", 2018, equation 1; version 0.1 of the linear weights, as published results use),
//! and VGG-19 with average pooling for L_perc of kind `vgg19` (spec 7.3).

use crate::device::disable_tf32;
use crate::error::Result;
use crate::io::WeightsFile;
use crate::model::{Precision, convolve};
use std::path::Path;
use tch::{Device, Kind, Tensor, nn};

/// Mean and standard deviation of the photos that the networks of LPIPS were trained on, per channel, for colors in [−1, 1].
const LPIPS_SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const LPIPS_SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Mean of the photos that VGG-19 was trained on, per channel, for colors in [0, 255].
const VGG19_MEANS: [f32; 3] = [123.68, 116.779, 103.939];
/// Divisors of the mean absolute differences of VGG-19's input and features, and of their sum.
const VGG19_DIVISORS: [f64; 6] = [1., 2.6, 4.8, 3.7, 5.6, 1.5 / 10.];
const VGG19_RANGE: f64 = 255.;
/// Constant added to the norms that the features of LPIPS are divided by.
const EPSILON: f64 = 1e-10;
/// Maximum number of pixels of an image that LPIPS compares as a whole. Larger images are compared in tiles: VGG-16's first features take 256
/// bytes per pixel, several times over.
const MAX_PIXELS: i64 = 1 << 20;
/// Approximate side of a tile in pixels.
const TILE: i64 = 640;
/// Upper bound on the number of pixels beyond a tile that its features depend on: 90 for VGG-16 and 80 for AlexNet, rounded up to a
/// multiple of [`LARGEST_STRIDE`].
const HALO: i64 = 96;
/// Stride of the last layer's features in pixels, for either network. The stride of every other layer divides it.
const LARGEST_STRIDE: i64 = 16;

/// Network whose features are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PerceptualBackbone {
    /// VGG-19 (Simonyan & Zisserman 2015) with average pooling: its input, and its features after ReLU 1_2, 2_2, 3_2, 4_2 and 5_2.
    Vgg19,
    /// VGG-16 (Simonyan & Zisserman 2015) for LPIPS, with features after ReLU 1_2, 2_2, 3_3, 4_3 and 5_3.
    LpipsVgg,
    /// AlexNet in its one-tower form (Krizhevsky 2014) for LPIPS, with features after each of the five ReLUs.
    LpipsAlex,
}

/// Convolution: its name, its number of channels, its kernel size, stride and padding, whether a pooling precedes it, and whether its
/// features after the ReLU are compared.
type Layer = (&'static str, i64, [i64; 3], bool, bool);

/// Kernel size, stride and padding of every convolution of VGG.
const VGG: [i64; 3] = [3, 1, 1];

/// The convolutions of VGG-19 up to ReLU 5_2, by their names in torchvision.
const VGG19_LAYERS: [Layer; 14] = [
    ("features.0", 64, VGG, false, false),
    ("features.2", 64, VGG, false, true),
    ("features.5", 128, VGG, true, false),
    ("features.7", 128, VGG, false, true),
    ("features.10", 256, VGG, true, false),
    ("features.12", 256, VGG, false, true),
    ("features.14", 256, VGG, false, false),
    ("features.16", 256, VGG, false, false),
    ("features.19", 512, VGG, true, false),
    ("features.21", 512, VGG, false, true),
    ("features.23", 512, VGG, false, false),
    ("features.25", 512, VGG, false, false),
    ("features.28", 512, VGG, true, false),
    ("features.30", 512, VGG, false, true),
];

const VGG16_LAYERS: [Layer; 13] = [
    ("conv1_1", 64, VGG, false, false),
    ("conv1_2", 64, VGG, false, true),
    ("conv2_1", 128, VGG, true, false),
    ("conv2_2", 128, VGG, false, true),
    ("conv3_1", 256, VGG, true, false),
    ("conv3_2", 256, VGG, false, false),
    ("conv3_3", 256, VGG, false, true),
    ("conv4_1", 512, VGG, true, false),
    ("conv4_2", 512, VGG, false, false),
    ("conv4_3", 512, VGG, false, true),
    ("conv5_1", 512, VGG, true, false),
    ("conv5_2", 512, VGG, false, false),
    ("conv5_3", 512, VGG, false, true),
];

const ALEXNET_LAYERS: [Layer; 5] = [
    ("conv1", 64, [11, 4, 2], false, true),
    ("conv2", 192, [5, 1, 2], true, true),
    ("conv3", 384, [3, 1, 1], true, true),
    ("conv4", 256, [3, 1, 1], false, true),
    ("conv5", 256, [3, 1, 1], false, true),
];

impl PerceptualBackbone {
    /// The networks of LPIPS.
    pub const LPIPS: [Self; 2] = [Self::LpipsVgg, Self::LpipsAlex];

    /// Returns the name of the metric in reports, or of the loss in configurations.
    pub fn metric(self) -> &'static str {
        match self {
            Self::Vgg19 => "vgg19",
            Self::LpipsVgg => "lpips_vgg",
            Self::LpipsAlex => "lpips_alex",
        }
    }

    /// Returns the file name of the weights. `make weights` makes those of LPIPS.
    pub fn file_name(self) -> String {
        format!("{}.safetensors", self.metric())
    }

    /// Returns the smallest side of an image in pixels. In a smaller image the last layer would have no features.
    pub fn smallest_side(self) -> i64 {
        match self {
            Self::Vgg19 | Self::LpipsVgg => 16,
            Self::LpipsAlex => 31,
        }
    }

    fn layers(self) -> &'static [Layer] {
        match self {
            Self::Vgg19 => &VGG19_LAYERS,
            Self::LpipsVgg => &VGG16_LAYERS,
            Self::LpipsAlex => &ALEXNET_LAYERS,
        }
    }

    /// Halves the resolution of features [B, C, H, W].
    fn pool(self, xs: &Tensor) -> Tensor {
        match self {
            Self::Vgg19 => xs.avg_pool2d([2, 2], [2, 2], [0, 0], false, true, None),
            Self::LpipsVgg => xs.max_pool2d([2, 2], [2, 2], [0, 0], [1, 1], false),
            Self::LpipsAlex => xs.max_pool2d([3, 3], [2, 2], [0, 0], [1, 1], false),
        }
    }

    /// Returns the stride in pixels of the features of every layer that is compared.
    fn strides(self) -> Vec<i64> {
        let mut stride = 1;
        let strides = self.layers().iter().filter_map(|(_, _, [_, of_layer, _], pooled, compared)| {
            stride *= of_layer * if *pooled { 2 } else { 1 };
            compared.then_some(stride)
        });
        strides.collect()
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

/// Network with its weights; in float32 by default. Its distances are differentiable.
#[derive(Debug)]
pub struct PerceptualNetwork {
    backbone: PerceptualBackbone,
    /// Precision of the convolutions; features are compared in float32.
    precision: Precision,
    /// Shift and divisor of the input, [1, 3, 1, 1].
    shift: Tensor,
    scale: Tensor,
    /// Convolutions, in the order of the backbone's layers.
    convolutions: Vec<nn::Conv2D>,
    /// Weights of the squared differences in each channel of LPIPS, [1, C, 1, 1], for each layer that is compared.
    linear: Vec<Tensor>,
}

impl PerceptualNetwork {
    /// Builds the network under `vs`: `conv….weight` [O, I, k, k] and `.bias` [O], `lin0.weight` to `lin4.weight` [1, C, 1, 1]; VGG-19 has
    /// torchvision's names, `features.0.weight`, …. They are zero until they are loaded.
    pub(crate) fn new(vs: &nn::Path, backbone: PerceptualBackbone) -> Self {
        disable_tf32();
        let zero = nn::Init::Const(0.);
        let (mut inputs, mut convolutions, mut linear) = (3, vec![], vec![]);
        for &(name, channels, [kernel, stride, padding], _, compared) in backbone.layers() {
            let path = match name.split_once('.') {
                Some((folder, number)) => vs.sub(folder).sub(number),
                None => vs.sub(name),
            };
            let config =
                nn::ConvConfig { stride, padding, ws_init: zero, bs_init: zero, ..Default::default() };
            convolutions.push(nn::conv2d(path, inputs, channels, kernel, config));
            if compared && backbone != PerceptualBackbone::Vgg19 {
                linear.push(vs.sub(format!("lin{}", linear.len())).var("weight", &[1, channels, 1, 1], zero));
            }
            inputs = channels;
        }
        let (shift, scale) = match backbone {
            PerceptualBackbone::Vgg19 => (VGG19_MEANS, [1.; 3]),
            _ => (LPIPS_SHIFT, LPIPS_SCALE),
        };
        let [shift, scale] = [shift, scale]
            .map(|values| Tensor::from_slice(&values).view([1, 3, 1, 1]).to_device(vs.device()));
        PerceptualNetwork { backbone, precision: Precision::default(), shift, scale, convolutions, linear }
    }

    /// Loads the weights that `make weights` creates, or torchvision's of VGG-19, of which layers after ReLU 5_2 are ignored. They need no
    /// gradient; images may.
    ///
    /// # Errors
    /// Returns an error if the file can't be read or holds another network.
    pub fn load(path: &Path, backbone: PerceptualBackbone, device: Device) -> Result<Self> {
        let mut vs = nn::VarStore::new(device);
        let network = PerceptualNetwork::new(&vs.root(), backbone);
        let weights = WeightsFile::open(path)?;
        match backbone {
            PerceptualBackbone::Vgg19 => {
                let known = vs.variables();
                weights
                    .rename_tensors(|name| known.contains_key(name).then(|| name.into()))
                    .load_into(&vs)?;
            }
            _ => weights.load_into(&vs)?,
        }
        vs.freeze();
        Ok(network)
    }

    /// Converts the network, whose weights are loaded, to `precision`.
    pub fn with_precision(mut self, precision: Precision) -> Self {
        self.convolutions.iter_mut().for_each(|convolution| precision.convert(convolution));
        PerceptualNetwork { precision, ..self }
    }

    /// Returns the network whose features are compared.
    pub fn backbone(&self) -> PerceptualBackbone {
        self.backbone
    }

    /// Returns the device of the weights, on which images must be, too.
    pub fn device(&self) -> Device {
        self.shift.device()
    }

    /// Computes the LPIPS distance of two images: 0 for equal ones. Both are […, 3, H, W] in [0, 1], float32, H and W at least
    /// [`PerceptualBackbone::smallest_side`]; the result is […]. Large images are processed in tiles that overlap by the network's receptive
    /// field, so the result is that for the whole image except for the order of sums.
    ///
    /// # Panics
    /// Panics if the images have another shape or a smaller size, or if the network isn't one of LPIPS.
    pub fn distance(&self, image: &Tensor, ground_truth: &Tensor) -> Tensor {
        assert!(!self.linear.is_empty(), "LPIPS has weights of its differences");
        let size = image.size();
        let [.., height, width] = size[..] else { panic!("an image has shape {size:?}") };
        let distance = match height * width <= MAX_PIXELS {
            true => self.compare(self.features(image), self.features(ground_truth)),
            false => self.distance_in_tiles(image, ground_truth, TILE),
        };
        distance.view(&size[..size.len() - 3])
    }

    /// Computes [`PerceptualNetwork::distance`] of B images, `[B]`, in tiles with sides of about `length` pixels.
    fn distance_in_tiles(&self, image: &Tensor, ground_truth: &Tensor, length: i64) -> Tensor {
        let [.., height, width] = image.size()[..] else { panic!("an image has height and width") };
        let columns = Tile::split(width, length);
        let tiles =
            Tile::split(height, length).flat_map(|row| columns.clone().map(move |column| (row, column)));
        let strides = self.backbone.strides();
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

    /// Computes the features that are compared, layer by layer and lazily: [B, C, H', W']. `images` are B images [.., 3, H, W] in [0, 1].
    /// The features of LPIPS are divided by their norm over the channels; those of VGG-19 begin with its input, 255·x − mean.
    pub fn features(&self, images: &Tensor) -> impl Iterator<Item = Tensor> {
        let size = images.size();
        let images = images.reshape([-1, 3, size[size.len() - 2], size[size.len() - 1]]);
        // Kind of the weights of LPIPS, in which features are compared.
        let kind = self.linear.first().map(Tensor::kind);
        let images = if kind.is_some() { images * 2. - 1. } else { images * VGG19_RANGE };
        let input = (images - &self.shift) / &self.scale;
        let mut xs = self.precision.images(&input);
        let layers = self.backbone.layers().iter().zip(&self.convolutions);
        let features = layers.filter_map(move |((.., pooled, compared), convolution)| {
            if *pooled {
                xs = self.backbone.pool(&xs);
            }
            xs = convolve(convolution, &xs);
            compared.then(|| match kind {
                Some(kind) => unit(&xs.to_kind(kind)),
                None => xs.shallow_clone(),
            })
        });
        kind.is_none().then_some(input).into_iter().chain(features)
    }

    /// Computes the mean distance of B images from the features of two batches; a scalar.
    pub fn mean_distance(&self, a: &[Tensor], b: &[Tensor]) -> Tensor {
        if !self.linear.is_empty() {
            let each = |features: &[Tensor]| features.iter().map(Tensor::shallow_clone).collect::<Vec<_>>();
            return self.compare(each(a).into_iter(), each(b).into_iter()).mean(None::<Kind>);
        }
        let float = |features: &Tensor| features.to_kind(Kind::Float);
        let differences = a.iter().zip(b).zip(VGG19_DIVISORS);
        let differences =
            differences.map(|((a, b), divisor)| (float(a) - float(b)).abs().mean(None::<Kind>) / divisor);
        differences.reduce(|sum, difference| sum + difference).expect("six terms") / VGG19_RANGE
    }

    /// Computes Σ over layers of the mean over pixels of Σ over channels of w (â − b̂)², `[B]`, from the features of two batches of B
    /// images.
    fn compare(&self, a: impl Iterator<Item = Tensor>, b: impl Iterator<Item = Tensor>) -> Tensor {
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
        let pairs = self.linear.iter().zip(a.zip(b));
        pairs.map(|(linear, (a, b))| (a - b).square().conv2d(linear, None::<&Tensor>, 1, 0, 1, 1))
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
        for network in PerceptualBackbone::LPIPS {
            let vs = nn::VarStore::new(Device::Cpu);
            let lpips = PerceptualNetwork::new(&vs.root(), network);
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

    /// Loss and gradient in bf16 are near those in float32, for images at several distances from the ground truth, of about 14 and 34 dB: the
    /// smaller the difference, the larger the relative rounding error.
    #[test]
    fn bf16_is_float32_but_for_its_rounding() {
        tch::manual_seed(7);
        let stores = [(); 2].map(|()| nn::VarStore::new(Device::Cpu));
        let [exact, rounded] =
            stores.each_ref().map(|vs| PerceptualNetwork::new(&vs.root(), PerceptualBackbone::Vgg19));
        tch::no_grad(|| {
            for (name, mut kernel) in stores[0].variables().into_iter().filter(|(_, t)| t.dim() == 4) {
                let bound = (6. / (9. * kernel.size()[1] as f64)).sqrt();
                let _ = kernel.uniform_(-bound, bound);
                stores[1].variables()[&name].shallow_clone().copy_(&kernel);
            }
        });
        let networks = [exact, rounded.with_precision(Precision::Bf16)];
        let options = (Kind::Float, Device::Cpu);
        let blocks = [4, 12, 32, 64].map(|count| {
            Tensor::rand([1, 3, count, count], options).upsample_nearest2d([64, 64], None, None)
        });
        let ground_truth = blocks.into_iter().reduce(|sum, block| sum + block).expect("four") / 4.;
        for amplitude in [0.4, 0.04] {
            let noise = (Tensor::rand([1, 3, 64, 64], options) * 2. - 1.) * amplitude;
            let [exact, rounded] = networks.each_ref().map(|network| {
                let image = (&ground_truth + &noise).clamp(0., 1.).set_requires_grad(true);
                let features = |image| network.features(image).collect::<Vec<_>>();
                let loss = network.mean_distance(&features(&image), &features(&ground_truth));
                loss.backward();
                (loss.double_value(&[]), image.grad().flatten(0, -1).to_kind(Kind::Double))
            });
            let off = (rounded.0 / exact.0 - 1.).abs();
            let cosine = rounded.1.dot(&exact.1) / (rounded.1.norm() * exact.1.norm());
            let cosine = cosine.double_value(&[]);
            assert!(off > 0. && off <= 1e-2, "loss {:.4}, off by {off:.1e}", exact.0);
            assert!((0.98..0.99999).contains(&cosine), "cosine of the gradients {cosine:.5}");
        }
    }
}
