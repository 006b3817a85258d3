//! LPIPS, a distance of pictures as people see it: Zhang et al., "The Unreasonable Effectiveness of Deep Features as a
//! Perceptual Metric", 2018, equation 1. Version 0.1 of its linear weights, with which published numbers are made.

use crate::device::leave_out_tf32;
use crate::error::Result;
use crate::io::WeightsFile;
use crate::model::{Precision, convolve};
use std::path::Path;
use tch::{Device, Kind, Tensor, nn};

/// What the distance takes from pictures in [−1, 1], per channel, and divides them by: the mean and standard deviation of
/// the photos that the networks were trained on.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Added to the norms that features are divided by.
const EPSILON: f64 = 1e-10;
/// Pictures of more pixels are compared in tiles: VGG-16's first features take 256 bytes a pixel, several times over.
const MOST_PIXELS: i64 = 1 << 20;
/// Side of a tile in pixels, about.
const TILE: i64 = 640;
/// The pixels beside a tile that features inside depend on, at the most: 90 for VGG-16 and 80 for AlexNet, as a multiple of
/// [`LARGEST_STRIDE`].
const HALO: i64 = 96;
/// Pixels between the last layer's features, in either network. Every other layer's stride divides it.
const LARGEST_STRIDE: i64 = 16;

/// The network whose features are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LpipsNetwork {
    /// VGG-16 (Simonyan & Zisserman 2015), features after ReLU 1_2, 2_2, 3_3, 4_3 and 5_3.
    Vgg16,
    /// AlexNet in its one-tower form (Krizhevsky 2014), features after each of the five ReLUs.
    AlexNet,
}

/// One convolution with its ReLU, and what stands before and after it.
struct Layer {
    name: &'static str,
    channels: i64,
    kernel: i64,
    stride: i64,
    padding: i64,
    /// A max pooling comes before.
    pooled: bool,
    /// Its features are compared.
    compared: bool,
}

impl LpipsNetwork {
    /// Both.
    pub const ALL: [LpipsNetwork; 2] = [LpipsNetwork::Vgg16, LpipsNetwork::AlexNet];

    /// What the distance is called in reports.
    pub fn metric(self) -> &'static str {
        match self {
            LpipsNetwork::Vgg16 => "lpips_vgg",
            LpipsNetwork::AlexNet => "lpips_alex",
        }
    }

    /// What `make weights` calls the file of the weights.
    pub fn file_name(self) -> &'static str {
        match self {
            LpipsNetwork::Vgg16 => "lpips_vgg.safetensors",
            LpipsNetwork::AlexNet => "lpips_alex.safetensors",
        }
    }

    /// In pixels: of a smaller picture nothing would be left for the last layer.
    pub fn smallest_side(self) -> i64 {
        match self {
            LpipsNetwork::Vgg16 => 16,
            LpipsNetwork::AlexNet => 31,
        }
    }

    /// Pixels between features, of every layer that is compared.
    fn strides(self) -> Vec<i64> {
        let mut stride = 1;
        let layers = self.layers().into_iter().filter_map(|layer| {
            stride *= layer.stride * if layer.pooled { 2 } else { 1 };
            layer.compared.then_some(stride)
        });
        layers.collect()
    }

    /// Side of the max poolings' windows, which are 2 apart.
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

/// A tile along one side of a picture, in pixels.
#[derive(Debug, Clone, Copy)]
struct Tile {
    /// The first pixel of the tile, a multiple of [`LARGEST_STRIDE`].
    first: i64,
    /// The pixel after its last.
    end: i64,
    /// The first pixel that the network is shown.
    shown: i64,
    /// The pixel after the last one that it is shown.
    shown_end: i64,
}

impl Tile {
    /// Divides `side` pixels into tiles of about `length`.
    fn cover(side: i64, length: i64) -> impl Iterator<Item = Tile> + Clone {
        let count = (side + length - 1) / length;
        let step = (side / count / LARGEST_STRIDE + 1) * LARGEST_STRIDE;
        (0..side).step_by(step as usize).map(move |first| {
            let end = (first + step).min(side);
            Tile { first, end, shown: (first - HALO).max(0), shown_end: (end + HALO).min(side) }
        })
    }

    /// Cuts what the network is shown out of `pictures` along `dim`.
    fn cut(self, pictures: &Tensor, dim: i64) -> Tensor {
        pictures.narrow(dim, self.shown, self.shown_end - self.shown)
    }

    /// Keeps the tile's own values of `features`, which are `stride` pixels apart along `dim`. At the picture's end a layer may have
    /// fewer than the pixels have room for.
    fn keep(self, features: &Tensor, dim: i64, stride: i64) -> Tensor {
        let there = features.size()[dim as usize];
        let first = ((self.first - self.shown) / stride).min(there);
        let is_last = self.end == self.shown_end;
        let count = if is_last { there } else { (self.end - self.first) / stride };
        features.narrow(dim, first, count.min(there - first))
    }
}

/// The distance, differentiable; in float32 unless something else is asked for.
#[derive(Debug)]
pub struct Lpips {
    network: LpipsNetwork,
    /// Of the convolutions; features are normalized and compared in float32.
    precision: Precision,
    /// [1, 3, 1, 1].
    shift: Tensor,
    /// [1, 3, 1, 1].
    scale: Tensor,
    steps: Vec<Step>,
}

/// A [`Layer`] with its weights.
#[derive(Debug)]
struct Step {
    pooled: bool,
    convolution: nn::Conv2D,
    /// What a squared difference in each channel counts, [1, C, 1, 1], where features are compared.
    linear: Option<Tensor>,
}

impl Lpips {
    /// Builds the network under `vs`: `conv….weight` [O, I, k, k] and `.bias` [O], `lin0.weight` to `lin4.weight`
    /// [1, C, 1, 1]. They are zero until they are loaded.
    pub(crate) fn new(vs: &nn::Path, network: LpipsNetwork) -> Self {
        leave_out_tf32();
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

    /// Reads the weights that `make weights` makes. They take no gradient; pictures do.
    ///
    /// # Errors
    /// A file that can't be read or holds another network.
    pub fn load(path: &Path, network: LpipsNetwork, device: Device) -> Result<Self> {
        let mut vs = nn::VarStore::new(device);
        let lpips = Lpips::new(&vs.root(), network);
        WeightsFile::open(path)?.load_into(&vs)?;
        vs.freeze();
        Ok(lpips)
    }

    /// The distance, once its network has its weights, in `precision` from now on.
    pub fn with_precision(mut self, precision: Precision) -> Self {
        self.steps.iter_mut().for_each(|step| precision.convert(&mut step.convolution));
        Lpips { precision, ..self }
    }

    /// Whose features are compared.
    pub fn network(&self) -> LpipsNetwork {
        self.network
    }

    /// Where the weights are, and pictures have to be.
    pub fn device(&self) -> Device {
        self.shift.device()
    }

    /// How differently two pictures look: 0 for equal ones. Both […, 3, H, W] in [0, 1], float32, H and W at least
    /// [`LpipsNetwork::smallest_side`]; the result is […]. Large pictures go through the network in tiles that overlap by as much as
    /// features look around, so the result is that of the whole but for the order of sums.
    ///
    /// # Panics
    /// Pictures of another shape or a smaller size.
    pub fn distance(&self, picture: &Tensor, truth: &Tensor) -> Tensor {
        let size = picture.size();
        let [.., height, width] = size[..] else { panic!("a picture has shape {size:?}") };
        let distance = match height * width <= MOST_PIXELS {
            true => self.compare(self.features(picture), self.features(truth)),
            false => self.distance_in_tiles(picture, truth, TILE),
        };
        distance.view(&size[..size.len() - 3])
    }

    /// Computes [`Lpips::distance`] of B pictures, `[B]`, in tiles of about `length` pixels a side.
    fn distance_in_tiles(&self, picture: &Tensor, truth: &Tensor, length: i64) -> Tensor {
        let [.., height, width] = picture.size()[..] else { panic!("a picture has two sides") };
        let columns = Tile::cover(width, length);
        let tiles =
            Tile::cover(height, length).flat_map(|row| columns.clone().map(move |column| (row, column)));
        let strides = self.network.strides();
        // Of every layer the sum over pixels, [B], and how many they are.
        let mut sums: Vec<Option<(Tensor, i64)>> = strides.iter().map(|_| None).collect();
        for (row, column) in tiles {
            let cut = |pictures: &Tensor| {
                let dims = pictures.dim() as i64;
                column.cut(&row.cut(pictures, dims - 2), dims - 1)
            };
            let (picture, truth) = (cut(picture), cut(truth));
            let differences = self.differences(self.features(&picture), self.features(&truth));
            for ((difference, stride), sum) in differences.zip(&strides).zip(&mut sums) {
                let own = column.keep(&row.keep(&difference, 2, *stride), 3, *stride);
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

    /// What [`Lpips::compare`] compares, layer by layer: features that are divided by their norm over the channels,
    /// [B, C, H', W']. Pictures as for [`Lpips::distance`], B of them. They are computed as they are asked for.
    pub fn features(&self, pictures: &Tensor) -> impl Iterator<Item = Tensor> {
        let size = pictures.size();
        let pictures = pictures.reshape([-1, 3, size[size.len() - 2], size[size.len() - 1]]);
        let mut xs = self.precision.images(&((pictures * 2. - 1. - &self.shift) / &self.scale));
        self.steps.iter().filter_map(move |step| {
            if step.pooled {
                let pool = self.network.pool();
                xs = xs.max_pool2d([pool, pool], [2, 2], [0, 0], [1, 1], false);
            }
            xs = convolve(&step.convolution, &xs);
            step.linear.is_some().then(|| unit(&xs.to_kind(Kind::Float)))
        })
    }

    /// Σ over layers of the mean over pixels of Σ over channels of w (â − b̂)²: `[B]` of two times B pictures.
    pub fn compare(&self, a: impl Iterator<Item = Tensor>, b: impl Iterator<Item = Tensor>) -> Tensor {
        self.differences(a, b)
            .map(|difference| difference.mean_dim([1i64, 2, 3].as_slice(), false, None::<Kind>))
            .reduce(|sum, distance| sum + distance)
            .expect("five layers")
    }

    /// Σ over channels of w (â − b̂)², layer by layer, [B, 1, H', W'].
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

/// Features [B, C, H, W] divided by their norm over C. Where all channels are 0 the norm has no derivative, and the ReLU
/// before lets none through.
fn unit(features: &Tensor) -> Tensor {
    features / (features.norm_scalaropt_dim(2., [1i64].as_slice(), true) + EPSILON)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_are_the_whole() {
        tch::manual_seed(3);
        for network in LpipsNetwork::ALL {
            let vs = nn::VarStore::new(Device::Cpu);
            let lpips = Lpips::new(&vs.root(), network);
            // As in trained networks, about half of the features are 0.
            tch::no_grad(|| {
                for mut variable in vs.variables().into_values() {
                    let inputs = variable.size()[1..].iter().product::<i64>().max(1);
                    let _ = variable.normal_(0., (2. / inputs as f64).sqrt());
                    // Differences count one way alone.
                    if variable.size().first() == Some(&1) {
                        let _ = variable.abs_();
                    }
                }
            });
            assert_eq!(network.strides().last(), Some(&LARGEST_STRIDE));
            // Sides that the strides divide and don't, and one with a last tile that AlexNet has no feature for.
            for (height, width) in [(64, 288), (81, 241), (129, 193)] {
                let picture = || Tensor::rand([1, 3, height, width], (Kind::Float, Device::Cpu));
                let (a, b) = (picture(), picture());
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
