//! Image tokens: the colours of a patch, and the rays along which it is seen (spec 3.1 and 3.2).

use super::camera_code::CameraCode;
use super::config::ModelConfig;
use super::layers::default_linear;
use super::precision::Precision;
use crate::scene::{RadialWarp, plucker_rays};
use tch::{Tensor, nn};

/// Mean of ImageNet by channel: the colour that RGB tokens have as 0.
pub const IMAGENET_MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const IMAGENET_STD: [f32; 3] = [0.229, 0.224, 0.225];
/// Number of values per ray: moment and direction.
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

/// Tokenizer of images and cameras.
#[derive(Debug)]
pub struct Tokenizer {
    rgb: RgbTokens,
    ray: RayTokens,
}

impl Tokenizer {
    /// Builds the tokenizer; `vs` is the model's root.
    pub fn new(vs: &nn::Path, config: &ModelConfig) -> Self {
        Tokenizer { rgb: RgbTokens::new(vs, config), ray: RayTokens::new(vs, config) }
    }

    /// Computes image tokens, [B, V, P, ray width + RGB width], from `images` [B, V, 3, H, W] in [0, 1], `c2w` [B, V, 4, 4] and
    /// `intrinsics` [B, V, 3, 3] in pixels. With a `warp`, rays and cameras are those of the warped world.
    pub fn forward(
        &self,
        images: &Tensor,
        c2w: &Tensor,
        intrinsics: &Tensor,
        warp: Option<&RadialWarp>,
    ) -> Tensor {
        let (height, width) = (images.size()[3], images.size()[4]);
        let rgb = self.rgb.forward(images);
        let (rays, c2w) = match warp {
            Some(warp) => (warp.rays(c2w, intrinsics), &warp.cameras(c2w)),
            None => (plucker_rays(c2w, intrinsics, height, width), c2w),
        };
        let ray = self.ray.forward(&rays, c2w, intrinsics);
        Tensor::cat(&[ray, rgb], -1)
    }
}

/// RGB half of image tokens.
#[derive(Debug)]
pub(crate) struct RgbTokens {
    patch_size: i64,
    /// Mean of ImageNet by channel, [3, 1, 1]; `deviation` is the standard deviation.
    mean: Tensor,
    deviation: Tensor,
    project: nn::Linear,
}

impl RgbTokens {
    pub fn new(vs: &nn::Path, config: &ModelConfig) -> Self {
        let inputs = 3 * config.patch_size * config.patch_size;
        let project = default_linear(vs / "rgb_patch_embeds" / "1", inputs, config.rgb_width, false);
        let channels = |values: &[f32]| Tensor::from_slice(values).view([3, 1, 1]).to_device(vs.device());
        let [mean, deviation] = [&IMAGENET_MEAN, &IMAGENET_STD].map(|values| channels(values));
        RgbTokens { patch_size: config.patch_size, mean, deviation, project }
    }

    /// Computes RGB tokens, [B, V, P, RGB width], from `images` [B, V, 3, H, W] in [0, 1].
    pub fn forward(&self, images: &Tensor) -> Tensor {
        let normalized = (images - &self.mean) / &self.deviation;
        Precision::F32.linear(&self.project, &patchify(&normalized.permute([0, 1, 3, 4, 2]), self.patch_size))
    }
}

/// Ray half of image tokens: rays of the patches, and the camera code.
#[derive(Debug)]
pub(crate) struct RayTokens {
    patch_size: i64,
    project: nn::Linear,
    camera_code: Option<CameraCode>,
}

impl RayTokens {
    pub fn new(vs: &nn::Path, config: &ModelConfig) -> Self {
        let inputs = RAY_CHANNELS * config.patch_size * config.patch_size;
        RayTokens {
            patch_size: config.patch_size,
            project: default_linear(vs / "ray_patch_embeds" / "1", inputs, config.ray_width, false),
            camera_code: config.camera_code.then(|| CameraCode::new(&(vs / "view_pe"), config.ray_width)),
        }
    }

    /// Computes ray tokens, [B, V, P, ray width], from `rays` [B, V, H, W, 6], `c2w` [B, V, 4, 4] and `intrinsics` [B, V, 3, 3] in pixels.
    pub fn forward(&self, rays: &Tensor, c2w: &Tensor, intrinsics: &Tensor) -> Tensor {
        let (height, width) = (rays.size()[2], rays.size()[3]);
        let tokens = Precision::F32.linear(&self.project, &patchify(rays, self.patch_size));
        match &self.camera_code {
            Some(camera_code) => tokens + camera_code.forward(c2w, intrinsics, height, width).unsqueeze(2),
            None => tokens,
        }
    }
}
