//! Views as the tensors that model and renderer take.

use super::capture::View;
use crate::scene::pose_to_rows;
use glam::DMat4;
use std::borrow::Borrow;
use tch::{Device, Kind, Tensor};

/// V views of one scene, B = 1; or of B scenes after [`ViewBatch::stack`].
#[derive(Debug)]
pub struct ViewBatch {
    /// [B, V, 3, H, W] in [0, 1].
    pub images: Tensor,
    /// Camera-to-world, [B, V, 4, 4].
    pub c2w: Tensor,
    /// World-to-camera, [B, V, 4, 4].
    pub w2c: Tensor,
    /// In pixels, [B, V, 3, 3].
    pub intrinsics: Tensor,
}

/// Puts views of one size together; `poses` (camera-to-world) stand for the views' own, as after normalization.
pub fn view_batch<V: Borrow<View>>(views: &[V], poses: &[DMat4], device: Device) -> ViewBatch {
    let count = views.len() as i64;
    let images: Vec<&Tensor> = views.iter().map(|view| &view.borrow().image).collect();
    let matrices = |rows: Vec<f64>, size: i64| {
        Tensor::from_slice(&rows).view([1, count, size, size]).to_kind(Kind::Float).to_device(device)
    };
    ViewBatch {
        images: Tensor::stack(&images, 0).unsqueeze(0).to_device(device),
        c2w: matrices(poses.iter().flat_map(pose_to_rows).collect(), 4),
        w2c: matrices(poses.iter().flat_map(|pose| pose_to_rows(&pose.inverse())).collect(), 4),
        intrinsics: matrices(views.iter().flat_map(|v| v.borrow().camera.intrinsics.to_rows()).collect(), 3),
    }
}

impl ViewBatch {
    /// The views at `positions`, of every scene.
    pub fn select(&self, positions: &[usize]) -> Self {
        let index: Vec<i64> = positions.iter().map(|&p| p as i64).collect();
        let index = Tensor::from_slice(&index).to_device(self.images.device());
        let select = |t: &Tensor| t.index_select(1, &index);
        ViewBatch {
            images: select(&self.images),
            c2w: select(&self.c2w),
            w2c: select(&self.w2c),
            intrinsics: select(&self.intrinsics),
        }
    }

    /// Scenes with equally many views along the batch.
    pub fn stack<B: Borrow<ViewBatch>>(scenes: &[B]) -> Self {
        let cat = |field: fn(&ViewBatch) -> &Tensor| {
            Tensor::cat(&scenes.iter().map(|scene| field(scene.borrow())).collect::<Vec<_>>(), 0)
        };
        ViewBatch {
            images: cat(|s| &s.images),
            c2w: cat(|s| &s.c2w),
            w2c: cat(|s| &s.w2c),
            intrinsics: cat(|s| &s.intrinsics),
        }
    }
}
