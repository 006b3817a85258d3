//! What a training step looks at, as tensors.

use super::scene::LoadedScene;
use crate::data::batch::{ViewBatch, view_matrices};
use crate::data::pixels::CHANNELS;
use tch::{Device, Kind, Tensor};

/// The largest value of a byte.
const LEVELS: f32 = 255.;

/// The views of one training step, B scenes.
#[derive(Debug)]
pub struct Sample {
    /// The scenes', B.
    pub names: Vec<String>,
    /// What the model sees.
    pub context: ViewBatch,
    /// What its pictures are compared with.
    pub target: ViewBatch,
    /// Far end of the input views' frusta in each normalized scene, `[B]`.
    pub far: Tensor,
    /// Whether the second half of the batch is the first half's scenes again, seen through other photos.
    pub paired: bool,
}

impl Sample {
    /// `scenes` with equally many views of one size, side by side.
    pub fn of(scenes: &[LoadedScene], device: Device) -> Self {
        let far: Vec<f64> = scenes.iter().map(|scene| scene.far).collect();
        let batch = |chosen: fn(&LoadedScene) -> &[usize]| {
            let matrices = scenes.iter().map(|scene| {
                let cameras: Vec<_> = chosen(scene).iter().map(|&position| scene.cameras[position]).collect();
                view_matrices(&cameras, device)
            });
            ViewBatch::with_images(images(scenes, chosen, device), &matrices.collect::<Vec<_>>())
        };
        Sample {
            names: scenes.iter().map(|scene| scene.name.clone()).collect(),
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
            names: [&self.names[..], &self.names].concat(),
            context: ViewBatch::stack(&[self.context.select(&subsets[0]), self.context.select(&subsets[1])]),
            target: twice(&self.target),
            far: Tensor::cat(&[&self.far, &self.far], 0),
            paired: true,
        }
    }

    /// Scenes, those of a paired sample counted twice.
    pub fn scenes(&self) -> usize {
        self.far.size()[0] as usize
    }

    /// `count` scenes from `first` on, or as many as there are, of a sample that isn't paired.
    pub fn slice(&self, first: usize, count: usize) -> Self {
        let count = count.min(self.scenes() - first);
        let names = self.names[first..first + count].to_vec();
        let (first, count) = (first as i64, count as i64);
        Sample {
            names,
            context: self.context.scenes(first, count),
            target: self.target.scenes(first, count),
            far: self.far.narrow(0, first, count),
            paired: false,
        }
    }

    /// Photos that the model sees of every scene.
    pub fn context_views(&self) -> usize {
        self.context.images.size()[1] as usize
    }
}

/// The chosen images of all scenes, [B, V, 3, H, W] in [0, 1].
///
/// To a GPU they travel as bytes. On the CPU they become floats in one pass into the tensor's own memory and without
/// libtorch's threads, which would wait for each other, spinning, wherever loading keeps all cores busy.
fn images<'a>(scenes: &'a [LoadedScene], chosen: fn(&LoadedScene) -> &[usize], device: Device) -> Tensor {
    let (size, views) = (scenes[0].size, chosen(&scenes[0]).len());
    let image_bytes = CHANNELS * size.height as usize * size.width as usize;
    let image =
        |scene: &'a LoadedScene, position: usize| &scene.images[position * image_bytes..][..image_bytes];
    let of_scene = |scene| chosen(scene).iter().map(move |&position| image(scene, position));
    let images: Vec<&[u8]> = scenes.iter().flat_map(of_scene).collect();
    let shape = [scenes.len(), views, CHANNELS, size.height as usize, size.width as usize].map(|n| n as i64);
    if device != Device::Cpu {
        let bytes = Tensor::from_slice(&images.concat()).view(shape).to_device(device);
        let mut floats = bytes.to_kind(Kind::Float);
        let _in_place = floats.g_div_scalar_(f64::from(LEVELS));
        return floats;
    }
    let floats = Tensor::empty(shape, (Kind::Float, device));
    assert_eq!(floats.numel(), images.len() * image_bytes, "scenes of one kind");
    // SAFETY: a new contiguous tensor in the CPU's memory holds as many float32s, and nobody else knows it yet.
    let memory = unsafe { std::slice::from_raw_parts_mut(floats.data_ptr().cast::<f32>(), floats.numel()) };
    for (floats, bytes) in memory.chunks_exact_mut(image_bytes).zip(images) {
        for (float, &byte) in floats.iter_mut().zip(bytes) {
            *float = f32::from(byte) / LEVELS;
        }
    }
    floats
}
