//! Batches of views: images and cameras as the tensors that the model and the renderer take.

use super::view::{Pixels, View};
use crate::model::{IMAGENET_MEAN, ModelInput};
use crate::render::Cameras;
use crate::scene::{Camera, pose_to_rows};
use glam::DMat4;
use std::borrow::Borrow;
use tch::{Device, Kind, Tensor};

/// V views of one scene (B = 1), or of each of B scenes after [`ViewBatch::stack`].
#[derive(Debug)]
pub struct ViewBatch {
    /// Images, `[B, V, 3, H, W]`, values in [0, 1].
    pub images: Tensor,
    /// Weight of each pixel, `[B, V, 1, H, W]`: 1 where the pixel counts, 0 where it is masked out. `None` if every pixel counts.
    pub masks: Option<Tensor>,
    /// Depths of the pixels, `[B, V, 2, H, W]`: inverse depth along the camera's axis in the normalized world, and how sure it is, from 0 to
    /// 1. `None` if the model reads none.
    pub depths: Option<Tensor>,
    /// Camera-to-world matrices, `[B, V, 4, 4]`.
    pub c2w: Tensor,
    /// World-to-camera matrices, `[B, V, 4, 4]`.
    pub w2c: Tensor,
    /// Intrinsic matrices in pixels, `[B, V, 3, 3]`.
    pub intrinsics: Tensor,
}

/// Stacks views of equal size into a batch of one scene on `device`.
///
/// `poses` (camera-to-world) replace the views' own poses, for example with normalized ones.
pub fn view_batch<V: Borrow<View>>(views: &[V], poses: &[DMat4], device: Device) -> ViewBatch {
    let stack = |pixels: &[&Pixels]| Pixels::stack(pixels).unsqueeze(0).to_device(device);
    let images: Vec<&Pixels> = views.iter().map(|view| &view.borrow().image).collect();
    let masks = views.iter().any(|view| view.borrow().mask.is_some()).then(|| {
        let masks: Vec<Pixels> = views.iter().map(|view| view.borrow().mask_or_ones()).collect();
        stack(&masks.iter().collect::<Vec<_>>())
    });
    ViewBatch::with_images(stack(&images), masks, &[view_matrices(&cameras_at(views, poses), device)])
}

/// Returns the views at `positions` of a tensor `[B, V, …]`.
pub(crate) fn select_views(t: &Tensor, positions: &[usize]) -> Tensor {
    // An index tensor would have to be copied to the device first.
    Tensor::stack(&positions.iter().map(|&view| t.select(1, view as i64)).collect::<Vec<_>>(), 1)
}

/// Returns the cameras of `views` with `poses` in place of their own poses.
pub(crate) fn cameras_at<V: Borrow<View>>(views: &[V], poses: &[DMat4]) -> Vec<Camera> {
    views.iter().zip(poses).map(|(view, &c2w)| Camera { c2w, ..view.borrow().camera }).collect()
}

/// Returns the tensors c2w, w2c and intrinsics of one scene, `[1, V, …]` each.
pub(crate) fn view_matrices(cameras: &[Camera], device: Device) -> [Tensor; 3] {
    let count = cameras.len() as i64;
    let matrices = |rows: Vec<f64>, size: i64| {
        Tensor::from_slice(&rows).view([1, count, size, size]).to_kind(Kind::Float).to_device(device)
    };
    [
        matrices(cameras.iter().flat_map(|camera| pose_to_rows(&camera.c2w)).collect(), 4),
        matrices(cameras.iter().flat_map(|camera| pose_to_rows(&camera.c2w.inverse())).collect(), 4),
        matrices(cameras.iter().flat_map(|camera| camera.intrinsics.to_rows()).collect(), 3),
    ]
}

impl ViewBatch {
    /// Builds a batch without depths from `images` `[B, V, 3, H, W]`, their `masks` `[B, V, 1, H, W]`, and the `matrices` of B scenes, one
    /// result of [`view_matrices`] per scene.
    pub(super) fn with_images(images: Tensor, masks: Option<Tensor>, matrices: &[[Tensor; 3]]) -> Self {
        let cat =
            |which: usize| Tensor::cat(&matrices.iter().map(|scene| &scene[which]).collect::<Vec<_>>(), 0);
        ViewBatch { images, masks, depths: None, c2w: cat(0), w2c: cat(1), intrinsics: cat(2) }
    }

    /// Applies `f` to every tensor.
    pub(super) fn map(&self, mut f: impl FnMut(&Tensor) -> Tensor) -> Self {
        ViewBatch {
            images: f(&self.images),
            masks: self.masks.as_ref().map(&mut f),
            depths: self.depths.as_ref().map(&mut f),
            c2w: f(&self.c2w),
            w2c: f(&self.w2c),
            intrinsics: f(&self.intrinsics),
        }
    }

    /// Returns the views as a model sees them: masked pixels have the color that its normalization (spec 3.1) makes 0.
    pub fn model_input(&self) -> ModelInput {
        let images = match &self.masks {
            Some(masks) => {
                let neutral =
                    Tensor::from_slice(&IMAGENET_MEAN).view([3, 1, 1]).to_device(self.images.device());
                neutral.lerp_tensor(&self.images, masks)
            }
            None => self.images.shallow_clone(),
        };
        ModelInput {
            images,
            c2w: self.c2w.shallow_clone(),
            intrinsics: self.intrinsics.shallow_clone(),
            depths: self.depths.as_ref().map(Tensor::shallow_clone),
        }
    }

    /// Returns the cameras of the views.
    pub fn cameras(&self) -> Cameras {
        let size = self.images.size();
        Cameras {
            w2c: self.w2c.shallow_clone(),
            intrinsics: self.intrinsics.shallow_clone(),
            width: size[4],
            height: size[3],
        }
    }

    /// Returns the views at `positions` of every scene.
    pub fn select(&self, positions: &[usize]) -> Self {
        self.map(|t| select_views(t, positions))
    }

    /// Concatenates scenes that have equally many views along the batch dimension.
    pub fn stack<B: Borrow<ViewBatch>>(scenes: &[B]) -> Self {
        let cat = |field: fn(&ViewBatch) -> &Tensor| {
            Tensor::cat(&scenes.iter().map(|scene| field(scene.borrow())).collect::<Vec<_>>(), 0)
        };
        let masks = scenes.iter().any(|scene| scene.borrow().masks.is_some()).then(|| {
            // Every pixel of a scene without masks counts.
            let masks = scenes.iter().map(|scene| match &scene.borrow().masks {
                Some(masks) => masks.shallow_clone(),
                None => scene.borrow().images.narrow(-3, 0, 1).ones_like(),
            });
            Tensor::cat(&masks.collect::<Vec<_>>(), 0)
        });
        // Scenes of a batch come from one loader: all have depths, or none.
        let depths: Option<Vec<&Tensor>> =
            scenes.iter().map(|scene| scene.borrow().depths.as_ref()).collect();
        ViewBatch {
            images: cat(|s| &s.images),
            masks,
            depths: depths.map(|depths| Tensor::cat(&depths, 0)),
            c2w: cat(|s| &s.c2w),
            w2c: cat(|s| &s.w2c),
            intrinsics: cat(|s| &s.intrinsics),
        }
    }
}
