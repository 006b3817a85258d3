//! Image tokens: what a patch looks like, and along which rays (SPEC section 3).

use super::camera_code::CameraCode;
use super::config::ModelConfig;
use super::layers::default_linear;
use crate::scene::plucker_rays;
use tch::{Tensor, nn, nn::Module};

const IMAGENET_MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const IMAGENET_STD: [f32; 3] = [0.229, 0.224, 0.225];
/// Moment and direction.
const RAY_CHANNELS: i64 = 6;

/// Cuts [B, V, H, W, C] into [B, V, P, p·p·C]: patches row by row, each flattened as (row, column, channel).
pub fn patchify(xs: &Tensor, patch: i64) -> Tensor {
    let size = xs.size();
    let (b, v, h, w, c) = (size[0], size[1], size[2], size[3], size[4]);
    xs.reshape([b, v, h / patch, patch, w / patch, patch, c]).permute([0, 1, 2, 4, 3, 5, 6]).reshape([
        b,
        v,
        (h / patch) * (w / patch),
        patch * patch * c,
    ])
}

/// Images and cameras to tokens.
#[derive(Debug)]
pub struct Tokenizer {
    patch_size: i64,
    rgb: nn::Linear,
    ray: nn::Linear,
    camera_code: Option<CameraCode>,
}

impl Tokenizer {
    /// `vs` is the model's root.
    pub fn new(vs: &nn::Path, config: &ModelConfig) -> Self {
        let pixels = config.patch_size * config.patch_size;
        Tokenizer {
            patch_size: config.patch_size,
            rgb: default_linear(vs / "rgb_patch_embeds" / "1", 3 * pixels, config.rgb_width, false),
            ray: default_linear(
                vs / "ray_patch_embeds" / "1",
                RAY_CHANNELS * pixels,
                config.ray_width,
                false,
            ),
            camera_code: config.camera_code.then(|| CameraCode::new(vs / "view_pe", config.ray_width)),
        }
    }

    /// `images` [B, V, 3, H, W] in [0, 1], `c2w` [B, V, 4, 4], `intrinsics` [B, V, 3, 3] in pixels; the result is
    /// [B, V, P, ray width + RGB width].
    pub fn forward(&self, images: &Tensor, c2w: &Tensor, intrinsics: &Tensor) -> Tensor {
        let (height, width) = (images.size()[3], images.size()[4]);
        let channel = |values: &[f32]| Tensor::from_slice(values).view([3, 1, 1]).to_device(images.device());
        let normalized = (images - channel(&IMAGENET_MEAN)) / channel(&IMAGENET_STD);
        let rgb = self.rgb.forward(&patchify(&normalized.permute([0, 1, 3, 4, 2]), self.patch_size));

        let rays = plucker_rays(c2w, intrinsics, height, width);
        let ray = self.ray.forward(&patchify(&rays, self.patch_size));
        let ray = match &self.camera_code {
            Some(camera_code) => ray + camera_code.forward(c2w, intrinsics, height, width).unsqueeze(2),
            None => ray,
        };
        Tensor::cat(&[ray, rgb], -1)
    }
}
