//! What a training step looks at, as tensors.

use super::batch::{ViewBatch, view_matrices};
use super::loader::LoadedScene;
use super::planes::CHANNELS;
use tch::{Device, Kind, Tensor};

/// The views of one training step, B scenes.
#[derive(Debug)]
pub struct Sample {
    /// What the model sees.
    pub context: ViewBatch,
    /// What it is asked for.
    pub target: ViewBatch,
    /// Far end of the input views' frusta in each normalized scene, [B].
    pub far: Tensor,
    /// Whether the second half of the batch is the first half's scenes again, seen through other photos.
    pub paired: bool,
}

impl Sample {
    /// `scenes` with equally many views of one size, side by side. Images travel to the device as bytes.
    pub fn of(scenes: &[LoadedScene], device: Device) -> Self {
        let far: Vec<f64> = scenes.iter().map(|scene| scene.far).collect();
        let photos: Vec<Tensor> = scenes
            .iter()
            .map(|scene| {
                let shape = [-1, CHANNELS as i64, i64::from(scene.size.height), i64::from(scene.size.width)];
                Tensor::from_slice(&scene.images).view(shape).to_device(device)
            })
            .collect();
        let batch = |chosen: fn(&LoadedScene) -> &[usize]| {
            let images = scenes.iter().zip(&photos).map(|(scene, photos)| {
                let index: Vec<i64> = chosen(scene).iter().map(|&position| position as i64).collect();
                photos.index_select(0, &Tensor::from_slice(&index).to_device(device))
            });
            let mut images = Tensor::stack(&images.collect::<Vec<_>>(), 0).to_kind(Kind::Float);
            let _in_place = images.g_div_scalar_(255.);
            let matrices = scenes.iter().map(|scene| {
                let cameras: Vec<_> = chosen(scene).iter().map(|&position| scene.cameras[position]).collect();
                view_matrices(&cameras, device)
            });
            ViewBatch::with_images(images, &matrices.collect::<Vec<_>>())
        };
        Sample {
            context: batch(|scene| &scene.context),
            target: batch(|scene| &scene.target),
            far: Tensor::from_slice(&far).to_kind(Kind::Float).to_device(device),
            paired: false,
        }
    }

    /// Every scene twice, along the batch: first with the context views at `subsets[0]`, then with those at `subsets[1]`.
    pub fn paired(&self, subsets: &[Vec<usize>; 2]) -> Self {
        let twice = |batch: &ViewBatch| ViewBatch::stack(&[batch, batch]);
        Sample {
            context: ViewBatch::stack(&[self.context.select(&subsets[0]), self.context.select(&subsets[1])]),
            target: twice(&self.target),
            far: Tensor::cat(&[&self.far, &self.far], 0),
            paired: true,
        }
    }

    /// Photos that the model sees of every scene.
    pub fn context_views(&self) -> usize {
        self.context.images.size()[1] as usize
    }
}
