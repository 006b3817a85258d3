//! Samples: the views of a training step as tensors.

use super::scene::LoadedScene;
use crate::data::batch::{ViewBatch, view_matrices};
use crate::device::{PendingCopy, Upload};
use crate::error::Result;
use globalsplat_capture::CHANNELS;
use tch::{Device, Kind, Tensor};

/// Largest value of a byte.
const LEVELS: f32 = 255.;

/// Views of one training step for B scenes.
#[derive(Debug)]
pub struct Batch {
    /// Names of the B scenes.
    pub names: Vec<String>,
    /// Context views, the input of the model.
    pub context: ViewBatch,
    /// Target views, which renderings are compared with.
    pub target: ViewBatch,
    /// Far plane of the context views' frusta in each normalized scene, `[B]`.
    pub far: Tensor,
    /// `true` if the second half of the batch repeats the scenes of the first half with other context views.
    pub paired: bool,
}

impl Batch {
    /// Builds a batch of `scenes`, which must have equally many views of one size.
    ///
    /// # Errors
    /// Returns an error if the GPU is missing or fails, or if memory runs out.
    pub fn from_scenes(scenes: &[LoadedScene], device: Device) -> Result<Self> {
        Batch::from_scenes_with(scenes, &Upload::new(device)?)
    }

    /// Builds a batch like [`Batch::from_scenes`], reusing an existing [`Upload`].
    pub(crate) fn from_scenes_with(scenes: &[LoadedScene], upload: &Upload) -> Result<Self> {
        match upload.device() {
            Device::Cpu => Batch::on_host(scenes, |images, shape| Ok(floats(images, shape))),
            _ => PendingBatch::begin(scenes, upload)?.wait(),
        }
    }

    /// Builds a batch on the CPU. `images` makes a tensor of the given shape from the pixel bytes of the chosen images.
    fn on_host(scenes: &[LoadedScene], images: impl Fn(&[&[u8]], &[i64]) -> Result<Tensor>) -> Result<Self> {
        let far: Vec<f64> = scenes.iter().map(|scene| scene.far).collect();
        let batch = |chosen: fn(&LoadedScene) -> &[usize]| -> Result<ViewBatch> {
            let matrices = scenes.iter().map(|scene| {
                let cameras: Vec<_> = chosen(scene).iter().map(|&position| scene.cameras[position]).collect();
                view_matrices(&cameras, Device::Cpu)
            });
            let (chosen, shape) = chosen_images(scenes, chosen);
            Ok(ViewBatch::with_images(images(&chosen, &shape)?, &matrices.collect::<Vec<_>>()))
        };
        Ok(Batch {
            names: scenes.iter().map(|scene| scene.name.clone()).collect(),
            context: batch(|scene| &scene.context)?,
            target: batch(|scene| &scene.target)?,
            far: Tensor::from_slice(&far).to_kind(Kind::Float),
            paired: false,
        })
    }

    /// Returns every scene twice, along the batch dimension: first with the context views `subsets[0]`, then with `subsets[1]`.
    pub fn paired(&self, subsets: &[Vec<usize>; 2]) -> Self {
        let twice = |batch: &ViewBatch| ViewBatch::stack(&[batch, batch]);
        Batch {
            names: [&self.names[..], &self.names].concat(),
            context: ViewBatch::stack(&[self.context.select(&subsets[0]), self.context.select(&subsets[1])]),
            target: twice(&self.target),
            far: Tensor::cat(&[&self.far, &self.far], 0),
            paired: true,
        }
    }

    /// Returns the number of scenes. Scenes of a paired sample count twice.
    pub fn scenes(&self) -> usize {
        self.far.size()[0] as usize
    }

    /// Returns up to `count` scenes starting at `first`. The sample must not be paired.
    pub fn slice(&self, first: usize, count: usize) -> Self {
        let count = count.min(self.scenes() - first);
        let names = self.names[first..first + count].to_vec();
        let (first, count) = (first as i64, count as i64);
        Batch {
            names,
            context: self.context.scenes(first, count),
            target: self.target.scenes(first, count),
            far: self.far.narrow(0, first, count),
            paired: false,
        }
    }

    /// Returns the number of context views per scene.
    pub fn context_views(&self) -> usize {
        self.context.images.size()[1] as usize
    }
}

/// A sample that is being copied to a device.
///
/// Images are copied as bytes and converted to floats on the device.
#[derive(Debug)]
pub(super) struct PendingBatch {
    names: Vec<String>,
    tensors: PendingCopy<9>,
}

impl PendingBatch {
    /// Starts to copy the batch that [`Batch::from_scenes`] builds from `scenes`.
    pub fn begin(scenes: &[LoadedScene], upload: &Upload) -> Result<Self> {
        let Batch { names, context, target, far, .. } =
            Batch::on_host(scenes, |images, shape| Ok(bytes(images, upload.bytes(shape)?)))?;
        let ([a, b, c, d], [e, f, g, h]) = (context.tensors(), target.tensors());
        Ok(PendingBatch { names, tensors: upload.begin([a, b, c, d, e, f, g, h, &far])? })
    }

    /// Waits for the copies and returns the sample on the device.
    pub fn wait(self) -> Result<Batch> {
        let [a, b, c, d, e, f, g, h, far] = self.tensors.wait()?;
        let in_floats = |bytes: Tensor| {
            let mut floats = bytes.to_kind(Kind::Float);
            let _in_place = floats.g_div_scalar_(f64::from(LEVELS));
            floats
        };
        let context = ViewBatch::from_tensors([in_floats(a), b, c, d]);
        let target = ViewBatch::from_tensors([in_floats(e), f, g, h]);
        Ok(Batch { names: self.names, context, target, far, paired: false })
    }
}

/// Returns the chosen images of all scenes, scene by scene, and their common shape `[B, V, 3, H, W]`.
fn chosen_images(scenes: &[LoadedScene], chosen: fn(&LoadedScene) -> &[usize]) -> (Vec<&[u8]>, [i64; 5]) {
    let (size, views) = (scenes[0].size, chosen(&scenes[0]).len());
    let shape = [scenes.len(), views, CHANNELS, size.height as usize, size.width as usize];
    let bytes = shape[2..].iter().product();
    let of_scene = |scene| chosen(scene).iter().map(move |&position| image(scene, position, bytes));
    let images: Vec<&[u8]> = scenes.iter().flat_map(of_scene).collect();
    assert_eq!(images.len(), scenes.len() * views, "scenes of one kind");
    (images, shape.map(|n| n as i64))
}

/// Returns the scene's image at `position`; each image has `bytes` bytes.
fn image(scene: &LoadedScene, position: usize, bytes: usize) -> &[u8] {
    &scene.images[position * bytes..][..bytes]
}

/// Copies `images` one after the other into `memory`, a byte tensor on the CPU.
fn bytes(images: &[&[u8]], memory: Tensor) -> Tensor {
    let image_bytes = images[0].len();
    assert_eq!(memory.numel(), images.len() * image_bytes, "scenes of one kind");
    // SAFETY: `memory` is a new contiguous tensor in CPU memory with exactly this many bytes, and nothing else refers to it yet.
    let places = unsafe { std::slice::from_raw_parts_mut(memory.data_ptr().cast::<u8>(), memory.numel()) };
    for (place, image) in places.chunks_exact_mut(image_bytes).zip(images) {
        place.copy_from_slice(image);
    }
    memory
}

/// Converts `images` to floats in [0, 1] in one pass, directly into the tensor's memory. It avoids libtorch's threads, which would
/// spin while waiting for each other whenever loading keeps all cores busy.
fn floats(images: &[&[u8]], shape: &[i64]) -> Tensor {
    let image_bytes = images[0].len();
    let floats = Tensor::empty(shape, (Kind::Float, Device::Cpu));
    assert_eq!(floats.numel(), images.len() * image_bytes, "scenes of one kind");
    // SAFETY: `floats` is a new contiguous tensor in CPU memory with exactly this many float32 values, and nothing else refers to
    // it yet.
    let places = unsafe { std::slice::from_raw_parts_mut(floats.data_ptr().cast::<f32>(), floats.numel()) };
    for (place, image) in places.chunks_exact_mut(image_bytes).zip(images) {
        for (float, &byte) in place.iter_mut().zip(*image) {
            *float = f32::from(byte) / LEVELS;
        }
    }
    floats
}
