//! L_perc in bf16, which training offers as an option.

use crate::common::Random;
use globalsplat::loss::{LossConfig, PerceptualKind, PerceptualLoss};
use globalsplat::model::Precision;
use tch::{Device, Kind, Tensor};

const SIDE: u32 = 64;
/// Amplitudes of noise on images, for a PSNR of about 14 and 34 dB.
const NOISES: [f64; 2] = [0.4, 0.04];

/// VGG-19's convolutions: their indices in torchvision's file, and output channels.
const LAYERS: [(i64, i64); 14] = [
    (0, 64),
    (2, 64),
    (5, 128),
    (7, 128),
    (10, 256),
    (12, 256),
    (14, 256),
    (16, 256),
    (19, 512),
    (21, 512),
    (23, 512),
    (25, 512),
    (28, 512),
    (30, 512),
];

/// Returns an image of random noise in blocks of several sizes, [1, 1, 3, SIDE, SIDE].
fn noise_blocks(random: &mut Random) -> Tensor {
    let side = i64::from(SIDE);
    let blocks = [4, 12, 32, side].map(|count| {
        let coarse = random.uniform(&[1, 3, count, count]).to_kind(Kind::Float);
        coarse.upsample_nearest2d([side, side], None, None)
    });
    (blocks.into_iter().reduce(|sum, block| sum + block).expect("four") / 4.).unsqueeze(0)
}

/// Loss and gradient in bf16 are near those in float32, for images at several distances from the ground truth: the smaller the difference,
/// the larger the relative rounding error.
#[test]
fn vgg19_in_bf16_is_float32_s() {
    let mut random = Random::new(7);
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("vgg19.safetensors");
    let (mut inputs, mut weights) = (3, vec![]);
    for (number, outputs) in LAYERS {
        let kernel = random.symmetric(&[outputs, inputs, 3, 3]) * (6. / (9. * inputs as f64)).sqrt();
        let bias = Tensor::zeros([outputs], (Kind::Float, Device::Cpu));
        weights.push((format!("features.{number}.weight"), kernel.to_kind(Kind::Float)));
        weights.push((format!("features.{number}.bias"), bias));
        inputs = outputs;
    }
    Tensor::write_safetensors(&weights, &file).expect("weights");
    let perceptual_weights = file.display().to_string();
    let config = LossConfig { perceptual: PerceptualKind::Vgg19, perceptual_weights, ..Default::default() };
    let networks = [Precision::F32, Precision::Bf16].map(|precision| {
        let loaded = PerceptualLoss::load(&config, [SIDE, SIDE].into(), Device::Cpu).expect("weights");
        loaded.expect("a network").with_precision(precision)
    });
    let ground_truth = noise_blocks(&mut random);
    for noise in NOISES {
        let noise = random.symmetric(&ground_truth.size()).to_kind(Kind::Float) * noise;
        let [exact, rounded] = networks.each_ref().map(|network| {
            let image = (&ground_truth + &noise).clamp(0., 1.).set_requires_grad(true);
            let loss = network.loss(&image, &ground_truth);
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
