//! L_perc (spec 7.3 and 7.4): the difference between images and ground truth in the features of a network trained on photos.

use super::config::{LossConfig, PerceptualKind};
use super::perceptual_network::{PerceptualBackbone, PerceptualNetwork};
use crate::error::{Error, Result};
use crate::io::{expand_path, find_pretrained, pretrained_folders};
use crate::model::{Precision, tracks_grad};
use crate::scene::ImageSize;
use std::path::PathBuf;
use tch::{Device, Kind, Tensor};
use tracing::trace_span;

/// Number of 256×256 images that go through the network together on a GPU. VGG-19 keeps 0.2 GB in float32 for each.
const GPU_CHUNK_SIZE: i64 = 16;

/// L_perc in training.
impl PerceptualNetwork {
    /// Loads the network that `config` asks for, if any, from the configured file, for images of `size`.
    ///
    /// # Errors
    /// Returns an error if the file is missing (with instructions on how to get it), if it holds another network, or if the images are too
    /// small for the network.
    pub fn from_config(config: &LossConfig, size: ImageSize, device: Device) -> Result<Option<Self>> {
        let file = &Self::weights_file(config)?;
        let Some(backbone) = config.perceptual.backbone() else { return Ok(None) };
        let (expected, how) = match backbone {
            PerceptualBackbone::Vgg19 => (
                "torchvision's vgg19 as a safetensors",
                "save_file(torchvision.models.vgg19(weights=\"IMAGENET1K_V1\").features.state_dict(prefix=\"features.\"), FILE) \
                 creates it; loss.perceptual=\"lpips_vgg\" needs only the files that `make weights` creates",
            ),
            _ => ("the weights of LPIPS", "`make weights` creates it"),
        };
        if !file.is_file() {
            let found = format!("{}, which doesn't exist", file.display());
            return Err(Error::request(format!(
                "loss.perceptual_weights is {found}, expected {expected} ({how})"
            )));
        }
        let network = PerceptualNetwork::load(file, backbone, device)?;
        let smallest = backbone.smallest_side();
        if i64::from(size.height.min(size.width)) < smallest {
            return Err(Error::request(format!(
                "data.image_size is [{}, {}], expected {smallest} or more for loss.perceptual",
                size.height, size.width
            )));
        }
        Ok(Some(network))
    }

    /// Returns an upper bound on the memory of the network in bytes: its weights, and the activations of those of `images` images of
    /// `size` that go through it at a time.
    pub fn max_memory_bytes(
        config: &LossConfig,
        precision: Precision,
        size: ImageSize,
        images: usize,
        device: Device,
    ) -> u64 {
        // Number of weights, and number of elements per pixel: activations, their gradients, and differences of the compared features.
        let (weights, of_pixel) = match config.perceptual {
            PerceptualKind::None => return 0,
            PerceptualKind::Vgg19 => (20.0e6, 780.),
            PerceptualKind::LpipsVgg => (14.7e6, 780.),
            PerceptualKind::LpipsAlex => (2.5e6, 60.),
        };
        let number = if precision == Precision::Bf16 { 2.5 } else { 4. };
        let pixels = i64::from(size.height) * i64::from(size.width);
        let chunk_size = Self::chunk_size(pixels, device).min(images as i64);
        (number * (weights + of_pixel * (chunk_size * pixels) as f64)) as u64
    }

    /// Returns the number of images of `pixels` pixels each that go through the network at a time.
    fn chunk_size(pixels: i64, device: Device) -> i64 {
        match device {
            Device::Cpu => 1,
            _ => (GPU_CHUNK_SIZE * 256 * 256 / pixels).max(1),
        }
    }

    /// Returns the configured weights file, with environment variables expanded. If none is configured, returns the file that `make
    /// weights` created, or the path at which it would create it.
    ///
    /// # Errors
    /// Returns an error if a variable isn't set and has no default.
    pub fn weights_file(config: &LossConfig) -> Result<PathBuf> {
        if !config.perceptual_weights.is_empty() {
            return expand_path(&config.perceptual_weights);
        }
        let name = config.perceptual.backbone().unwrap_or(PerceptualBackbone::Vgg19).file_name();
        Ok(find_pretrained(&name).unwrap_or_else(|| pretrained_folders()[0].join(name)))
    }

    /// Computes the mean loss over `rendered` [R·B, C, 3, H, W], which holds R renderings of `ground_truth` [B, C, 3, H, W] along the
    /// batch. The features of the ground truth are computed once and used R times. If a gradient is needed, it is computed in the forward
    /// pass, one image at a time on a CPU and a few at a time on a GPU: the activations of all images would take nearly as much memory as
    /// the rest of a training step. The number of images that go together depends on their size alone, because the last bits of sums depend
    /// on it.
    pub fn loss(&self, rendered: &Tensor, ground_truth: &Tensor) -> Tensor {
        let pixels = ground_truth.size()[3..].iter().product();
        let chunk_size = Self::chunk_size(pixels, rendered.device());
        self.loss_by_chunks(rendered, ground_truth, chunk_size)
    }

    /// Computes [`PerceptualNetwork::loss`] with `chunk_size` images at a time.
    fn loss_by_chunks(&self, rendered: &Tensor, ground_truth: &Tensor, chunk_size: i64) -> Tensor {
        let ground_truth = ground_truth.flatten(0, 1); // [B·C, 3, H, W]
        let (count, repeats) =
            (ground_truth.size()[0], rendered.size()[0] * rendered.size()[1] / ground_truth.size()[0]);
        let images = rendered.detach().reshape([&[repeats][..], &ground_truth.size()].concat());
        let gradient = tracks_grad(rendered).then(|| images.empty_like());
        let mut sum = Tensor::zeros([], (Kind::Float, rendered.device()));
        for first in (0..count).step_by(chunk_size as usize) {
            let length = chunk_size.min(count - first);
            let share = length as f64 / (count * repeats) as f64;
            let ground_truth = ground_truth.narrow(0, first, length);
            let ground_truth: Vec<Tensor> =
                trace_span!("L_perc").in_scope(|| tch::no_grad(|| self.features(&ground_truth).collect()));
            for turn in 0..repeats {
                let place = |of: &Tensor| of.select(0, turn).narrow(0, first, length);
                let image = place(&images).detach().set_requires_grad(gradient.is_some());
                let loss = trace_span!("L_perc").in_scope(|| {
                    self.mean_distance(&self.features(&image).collect::<Vec<_>>(), &ground_truth)
                }) * share;
                if let Some(gradient) = &gradient {
                    loss.backward();
                    place(gradient).copy_(&image.grad());
                }
                sum += loss.detach();
            }
        }
        match gradient {
            // Adds 0 to the value, and the precomputed gradient to the backward pass.
            Some(gradient) => {
                let way = (rendered * gradient.view_as(rendered)).sum(None::<Kind>);
                sum + (&way - way.detach())
            }
            None => sum,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::nn;

    #[test]
    fn loss_is_the_same_for_any_chunk_size() {
        tch::manual_seed(3);
        let vs = nn::VarStore::new(Device::Cpu);
        let loss = PerceptualNetwork::new(&vs.root(), PerceptualBackbone::LpipsAlex);
        vs.variables().into_values().for_each(|mut variable| {
            let _ = tch::no_grad(|| variable.uniform_(0., 0.05));
        });
        // Two renderings of five images.
        let images = |scenes: i64| Tensor::rand([scenes, 5, 3, 40, 33], (Kind::Float, Device::Cpu));
        let (rendered, ground_truth) = (images(2), images(1));
        let of_chunks = |chunk_size: i64| {
            let rendered = rendered.detach().set_requires_grad(true);
            let loss = loss.loss_by_chunks(&rendered, &ground_truth, chunk_size);
            loss.backward();
            (loss.double_value(&[]), rendered.grad())
        };
        let (value, gradient) = of_chunks(5);
        assert!(value > 0. && gradient.abs().max().double_value(&[]) > 0.);
        for chunk_size in [1, 2, 3, 7] {
            let (other, of_other) = of_chunks(chunk_size);
            let off = (&of_other - &gradient).abs().max() / gradient.abs().max();
            assert!((other / value - 1.).abs() < 1e-6, "{chunk_size}: {other} instead of {value}");
            assert!(off.double_value(&[]) < 1e-5, "{chunk_size}: {off}");
        }
    }
}
