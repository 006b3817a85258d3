//! Samples: scenes as passed from the loader threads to the training thread, and the views of a training step as tensors.

use crate::data::batch::{ViewBatch, view_matrices};
use crate::device::{PendingCopy, Upload};
use crate::error::Result;
use crate::scene::{Camera, ImageSize};
use globalsplat_capture::CHANNELS;
use std::ops::Range;
use tch::kind::Element;
use tch::{Device, Kind, Tensor};

/// A scene of a training sample: N photos, each of them context, target or both.
#[derive(Debug, Clone)]
pub struct LoadedScene {
    /// Name of the capture.
    pub name: String,
    /// 8-bit pixels, `[N, 3, H, W]`.
    pub images: Vec<u8>,
    /// 8-bit weights of the pixels, `[N, H, W]`: 255 where a pixel counts, 0 where it is masked out. `None` if every pixel counts.
    pub masks: Option<Vec<u8>>,
    /// Depths of the context images, `[C, 2, H, W]`: inverse depth in normalized world coordinates, and how sure it is. `None` if
    /// the model reads none.
    pub depths: Option<Vec<f32>>,
    /// Size of all images.
    pub size: ImageSize,
    /// Cameras of the images, in normalized world coordinates.
    pub cameras: Vec<Camera>,
    /// Indices of the context images, ascending.
    pub context: Vec<usize>,
    /// Indices of the target images, which renderings are compared with, ascending.
    pub target: Vec<usize>,
    /// Far plane of the frusta in normalized world coordinates.
    pub far: f64,
}

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
            // Converting in one pass avoids libtorch's threads, which would spin while waiting for each other whenever loading keeps
            // all cores busy.
            Device::Cpu => Batch::on_host(scenes, |images, shape| {
                let floats = Tensor::empty(shape, (Kind::Float, Device::Cpu));
                Ok(fill(floats, images, |byte| f32::from(byte) / 255.))
            }),
            _ => PendingBatch::begin(scenes, upload)?.wait(),
        }
    }

    /// Applies `f` to every tensor.
    fn map(&self, mut f: impl FnMut(&Tensor) -> Tensor) -> Self {
        Batch {
            names: self.names.clone(),
            context: self.context.map(&mut f),
            target: self.target.map(&mut f),
            far: f(&self.far),
            paired: self.paired,
        }
    }

    /// Builds a batch on the CPU. `images` makes a tensor of the given shape from the pixel bytes of the chosen images, or of their masks.
    fn on_host(scenes: &[LoadedScene], images: impl Fn(&[&[u8]], &[i64]) -> Result<Tensor>) -> Result<Self> {
        let far: Vec<f64> = scenes.iter().map(|scene| scene.far).collect();
        let has_masks = scenes.iter().any(|scene| scene.masks.is_some());
        // Every pixel of a scene without masks counts.
        let pixels = scenes[0].size.height as usize * scenes[0].size.width as usize;
        let ones = vec![u8::MAX; if has_masks { pixels } else { 0 }];
        let batch = |chosen: fn(&LoadedScene) -> &[usize]| -> Result<ViewBatch> {
            let matrices = scenes.iter().map(|scene| {
                let cameras: Vec<_> = chosen(scene).iter().map(|&position| scene.cameras[position]).collect();
                view_matrices(&cameras, Device::Cpu)
            });
            let (photos, shape) =
                chosen_planes(scenes, chosen, CHANNELS, |scene, place| &scene.images[place]);
            let photos = images(&photos, &shape)?;
            let masks = has_masks.then(|| {
                let (masks, shape) = chosen_planes(scenes, chosen, 1, |scene, place| match &scene.masks {
                    Some(masks) => &masks[place],
                    None => &ones,
                });
                images(&masks, &shape)
            });
            Ok(ViewBatch::with_images(photos, masks.transpose()?, &matrices.collect::<Vec<_>>()))
        };
        let [height, width] = [scenes[0].size.height, scenes[0].size.width].map(i64::from);
        let depths = scenes.iter().map(|scene| scene.depths.as_ref());
        let depths = depths.map(|depths| Some(Tensor::from_slice(depths?).view([-1, 2, height, width])));
        let depths: Option<Vec<Tensor>> = depths.collect();
        let context = batch(|scene| &scene.context)?;
        Ok(Batch {
            names: scenes.iter().map(|scene| scene.name.clone()).collect(),
            context: ViewBatch { depths: depths.map(|depths| Tensor::stack(&depths, 0)), ..context },
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
        Batch { names, ..self.map(|t| t.narrow(0, first as i64, count as i64)) }
    }

    /// Returns `targets`, a tensor of the target views, of every scene once: a paired sample has the same targets twice.
    pub(crate) fn unpaired(&self, targets: &Tensor) -> Tensor {
        targets.chunk(if self.paired { 2 } else { 1 }, 0).swap_remove(0)
    }

    /// Returns the masks of the target views of every scene once, `[B, C, 1, H, W]`; `None` if every pixel counts.
    pub(crate) fn target_masks(&self) -> Option<Tensor> {
        self.target.masks.as_ref().map(|masks| self.unpaired(masks))
    }

    /// Returns the number of context views per scene.
    pub fn context_views(&self) -> usize {
        self.context.images.size()[1] as usize
    }
}

/// A batch that is being copied to a device. Images are copied as bytes and converted to floats there.
#[derive(Debug)]
pub(super) struct PendingBatch {
    host: Batch,
    /// Copies of all tensors of `host`, in the order of [`Batch::map`].
    copies: PendingCopy,
}

impl PendingBatch {
    /// Starts to copy the batch that [`Batch::from_scenes`] builds from `scenes`.
    pub fn begin(scenes: &[LoadedScene], upload: &Upload) -> Result<Self> {
        let host =
            Batch::on_host(scenes, |images, shape| Ok(fill(upload.bytes(shape)?, images, |byte| byte)))?;
        let mut tensors = vec![];
        host.map(|t| {
            tensors.push(t.shallow_clone());
            t.shallow_clone()
        });
        Ok(PendingBatch { host, copies: upload.begin(&tensors)? })
    }

    /// Waits for the copies and returns the batch on the device.
    pub fn wait(self) -> Result<Batch> {
        let mut copies = self.copies.wait()?.into_iter();
        Ok(self.host.map(|_| {
            let copy = copies.next().expect("a copy of every tensor");
            match copy.kind() {
                Kind::Uint8 => copy.to_kind(Kind::Float).g_div_scalar_(255.),
                _ => copy,
            }
        }))
    }
}

/// Returns the planes of the chosen images of all scenes, `channels` of each, scene by scene, and their common shape
/// `[B, V, channels, H, W]`. `planes` returns the bytes of a scene in a range of those of all its images.
fn chosen_planes<'a>(
    scenes: &'a [LoadedScene],
    chosen: fn(&LoadedScene) -> &[usize],
    channels: usize,
    planes: impl Fn(&'a LoadedScene, Range<usize>) -> &'a [u8],
) -> (Vec<&'a [u8]>, [i64; 5]) {
    let (size, views) = (scenes[0].size, chosen(&scenes[0]).len());
    let shape = [scenes.len(), views, channels, size.height as usize, size.width as usize];
    let bytes: usize = shape[2..].iter().product();
    let planes = &planes;
    let of_scene = |scene| {
        chosen(scene).iter().map(move |&position| planes(scene, position * bytes..(position + 1) * bytes))
    };
    let images: Vec<&[u8]> = scenes.iter().flat_map(of_scene).collect();
    assert_eq!(images.len(), scenes.len() * views, "scenes of one kind");
    (images, shape.map(|n| n as i64))
}

/// Fills `tensor`, a new one on the CPU, with the converted bytes of `images`, one image after the other.
fn fill<T: Element>(tensor: Tensor, images: &[&[u8]], convert: impl Fn(u8) -> T) -> Tensor {
    let image_bytes = images[0].len();
    assert_eq!(tensor.kind(), T::KIND);
    assert_eq!(tensor.numel(), images.len() * image_bytes, "scenes of one kind");
    // SAFETY: `tensor` is a new contiguous tensor in CPU memory with exactly this many elements of this type, and nothing else refers to
    // it yet.
    let elements = unsafe { std::slice::from_raw_parts_mut(tensor.data_ptr().cast::<T>(), tensor.numel()) };
    for (elements, image) in elements.chunks_exact_mut(image_bytes).zip(images) {
        elements.iter_mut().zip(*image).for_each(|(element, &byte)| *element = convert(byte));
    }
    tensor
}
