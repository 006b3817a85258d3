//! L_perc of kind `vgg19` (spec 7.3): the distance of an image from the ground truth in the features of VGG-19 (Simonyan & Zisserman 2015)
//! with average pooling.

use crate::device::disable_tf32;
use crate::error::Result;
use crate::io::WeightsFile;
use crate::model::{Precision, convolve};
use std::path::Path;
use tch::{Device, Kind, Tensor, nn};

/// Values subtracted from 255·x: the mean of the photos that the network was trained on.
const MEANS: [f32; 3] = [123.68, 116.779, 103.939];

/// The 3×3 convolutions up to ReLU 5_2: index in torchvision's `features`, number of channels, whether a pooling precedes it, and the
/// divisor of the mean absolute difference of its features if they are compared.
const LAYERS: [(u32, i64, bool, Option<f64>); 14] = [
    (0, 64, false, None),
    (2, 64, false, Some(2.6)),
    (5, 128, true, None),
    (7, 128, false, Some(4.8)),
    (10, 256, true, None),
    (12, 256, false, Some(3.7)),
    (14, 256, false, None),
    (16, 256, false, None),
    (19, 512, true, None),
    (21, 512, false, Some(5.6)),
    (23, 512, false, None),
    (25, 512, false, None),
    (28, 512, true, None),
    (30, 512, false, Some(1.5 / 10.)),
];

/// Divisor of the sum of all differences.
const RANGE: f64 = 255.;

/// VGG-19 for the perceptual loss; in float32 by default.
#[derive(Debug)]
pub struct Vgg19 {
    /// Precision of the convolutions; features are compared in float32.
    precision: Precision,
    /// Mean per channel, [1, 3, 1, 1].
    means: Tensor,
    /// Convolutions, in the order of [`LAYERS`].
    convolutions: Vec<nn::Conv2D>,
}

impl Vgg19 {
    /// Minimum side of an image, so that features remain after four poolings.
    pub const SMALLEST_SIDE: i64 = 16;

    /// Builds the network under `vs`, with torchvision's names: `features.0.weight` [64, 3, 3, 3], `features.0.bias` [64], …. They are zero
    /// until they are loaded.
    pub(crate) fn new(vs: &nn::Path) -> Self {
        disable_tf32();
        let zero = nn::Init::Const(0.);
        let config = nn::ConvConfig { padding: 1, ws_init: zero, bs_init: zero, ..Default::default() };
        let mut inputs = 3;
        let mut convolution = |(number, channels, ..): (u32, i64, bool, Option<f64>)| {
            let built = nn::conv2d(vs / "features" / number, inputs, channels, 3, config);
            inputs = channels;
            built
        };
        Vgg19 {
            precision: Precision::default(),
            convolutions: LAYERS.map(&mut convolution).into(),
            means: Tensor::from_slice(&MEANS).view([1, 3, 1, 1]).to_device(vs.device()),
        }
    }

    /// Loads torchvision's weights from its own format or a safetensors file, and ignores layers after ReLU 5_2. The weights need no
    /// gradient; images may.
    ///
    /// # Errors
    /// Returns an error if the file can't be read or holds another network.
    pub fn load(path: &Path, device: Device) -> Result<Self> {
        let mut vs = nn::VarStore::new(device);
        let network = Vgg19::new(&vs.root());
        let known = vs.variables();
        let weights = WeightsFile::open(path)?;
        weights.rename_tensors(|name| known.contains_key(name).then(|| name.into())).load_into(&vs)?;
        vs.freeze();
        Ok(network)
    }

    /// Converts the network, whose weights are loaded, to `precision`.
    pub fn with_precision(mut self, precision: Precision) -> Self {
        self.convolutions.iter_mut().for_each(|convolution| precision.convert(convolution));
        Vgg19 { precision, ..self }
    }

    /// Computes the features that [`Vgg19::compare`] compares: the input 255·x − mean, and the features after ReLU 1_2, 2_2, 3_2, 4_2 and
    /// 5_2. Images are […, 3, H, W] in [0, 1], H and W at least [`Vgg19::SMALLEST_SIDE`].
    ///
    /// # Panics
    /// Panics if the images have another shape or a smaller size.
    pub fn features(&self, images: &Tensor) -> Vec<Tensor> {
        let size = images.size();
        let images = images.reshape([-1, 3, size[size.len() - 2], size[size.len() - 1]]);
        let mut xs = images * RANGE - &self.means;
        let mut features = vec![xs.shallow_clone()];
        xs = self.precision.images(&xs);
        for ((.., pooled, counts), convolution) in LAYERS.iter().zip(&self.convolutions) {
            if *pooled {
                xs = xs.avg_pool2d([2, 2], [2, 2], [0, 0], false, true, None);
            }
            xs = convolve(convolution, &xs);
            if counts.is_some() {
                features.push(xs.shallow_clone());
            }
        }
        features
    }

    /// Computes the loss from two lists of features: Σ of their mean absolute differences, each divided by its own divisor, over 255.
    pub fn compare(&self, image: &[Tensor], ground_truth: &[Tensor]) -> Tensor {
        let divisors = std::iter::once(1.).chain(LAYERS.iter().filter_map(|(.., divisor)| *divisor));
        let differences = image.iter().zip(ground_truth).zip(divisors);
        let float = |features: &Tensor| features.to_kind(Kind::Float);
        let differences =
            differences.map(|((a, b), divisor)| (float(a) - float(b)).abs().mean(None::<Kind>) / divisor);
        differences.reduce(|sum, difference| sum + difference).expect("six terms") / RANGE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Loss and gradient in bf16 are near those in float32, for images at several distances from the ground truth, of about 14 and 34 dB: the
    /// smaller the difference, the larger the relative rounding error.
    #[test]
    fn bf16_is_float32_but_for_its_rounding() {
        tch::manual_seed(7);
        let stores = [(); 2].map(|()| nn::VarStore::new(Device::Cpu));
        let [exact, rounded] = stores.each_ref().map(|vs| Vgg19::new(&vs.root()));
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
                let loss = network.compare(&network.features(&image), &network.features(&ground_truth));
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
