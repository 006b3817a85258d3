//! Image tokens: the colors of a patch, the rays along which it is seen and the camera that sees it (spec 3), normalized for the encoder.

use super::config::ModelConfig;
use super::layers::{default_linear, gelu, normalize_without_affine};
use super::precision::Precision;
use super::{ModelInput, leaf};
use crate::scene::{RadialWarp, plucker_rays};
use std::f64::consts::PI;
use tch::{Kind, Tensor, nn, nn::Module};
use tracing::trace_span;

/// Mean of ImageNet by channel: the color that RGB tokens have as 0.
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

/// Tokenizer of images and cameras: the RGB half of image tokens, and the ray half, which has the camera code, too.
#[derive(Debug)]
pub struct Tokenizer {
    patch_size: i64,
    /// Mean of ImageNet by channel, [3, 1, 1]; `deviation` is the standard deviation.
    mean: Tensor,
    deviation: Tensor,
    rgb: nn::Linear,
    rays: nn::Linear,
    camera_code: Option<CameraCode>,
}

impl Tokenizer {
    /// Builds the tokenizer; `vs` is the model's root.
    pub fn new(vs: &nn::Path, config: &ModelConfig) -> Self {
        let pixels = config.patch_size * config.patch_size;
        let channels = |values: &[f32]| Tensor::from_slice(values).view([3, 1, 1]).to_device(vs.device());
        let linear =
            |name: &str, inputs: i64, width: i64| default_linear(vs / name / "1", inputs, width, false);
        Tokenizer {
            patch_size: config.patch_size,
            mean: channels(&IMAGENET_MEAN),
            deviation: channels(&IMAGENET_STD),
            rgb: linear("rgb_patch_embeds", 3 * pixels, config.rgb_width),
            rays: linear("ray_patch_embeds", RAY_CHANNELS * pixels, config.ray_width),
            camera_code: config.camera_code.then(|| CameraCode::new(&(vs / "view_pe"), config.ray_width)),
        }
    }

    /// Computes raw image tokens, [B, V, P, ray width + RGB width]. With a `warp`, rays and cameras are those of the warped world.
    pub fn forward(&self, input: &ModelInput, warp: Option<&RadialWarp>) -> Tensor {
        let ModelInput { images, c2w, intrinsics, .. } = input;
        let (height, width) = (images.size()[3], images.size()[4]);
        let project =
            |layer: &nn::Linear, xs: &Tensor| Precision::F32.linear(layer, &patchify(xs, self.patch_size));
        let normalized = (images - &self.mean) / &self.deviation;
        let rgb = project(&self.rgb, &normalized.permute([0, 1, 3, 4, 2]));
        let (rays, c2w) = match warp {
            Some(warp) => (warp.rays(c2w, intrinsics), &warp.cameras(c2w)),
            None => (plucker_rays(c2w, intrinsics, height, width), c2w),
        };
        let ray = project(&self.rays, &rays); // of [B, V, H, W, 6]
        let ray = match &self.camera_code {
            Some(camera_code) => ray + camera_code.forward(c2w, intrinsics, height, width).unsqueeze(2),
            None => ray,
        };
        Tensor::cat(&[ray, rgb], -1)
    }
}

/// Width of the intrinsics features.
const INTRINSICS_WIDTH: i64 = 64;
/// Frequencies of the camera center's encoding, in units of π.
const FREQUENCIES: [f64; 4] = [1., 2., 4., 8.];
/// Width of the encoded camera center: the center, its sines and its cosines.
const CENTER_WIDTH: i64 = 3 + 2 * 3 * FREQUENCIES.len() as i64;

/// Camera code (spec 3.3): one vector per view that distinguishes cameras beyond their Plücker rays. An MLP encodes the intrinsics, sines and
/// cosines encode the camera center, and one linear layer joins both.
#[derive(Debug)]
struct CameraCode {
    intrinsics_in: nn::Linear,
    intrinsics_out: nn::Linear,
    project: nn::Linear,
}

impl CameraCode {
    fn new(vs: &nn::Path, width: i64) -> Self {
        let mlp = vs / "k_mlp";
        CameraCode {
            intrinsics_in: default_linear(&mlp / "0", 4, INTRINSICS_WIDTH, true),
            intrinsics_out: default_linear(&mlp / "2", INTRINSICS_WIDTH, INTRINSICS_WIDTH, true),
            project: default_linear(vs / "proj", INTRINSICS_WIDTH + CENTER_WIDTH, width, true),
        }
    }

    /// Computes the camera code, [B, V, width]. `c2w` is [B, V, 4, 4], `intrinsics` [B, V, 3, 3] in pixels of a `height` × `width` image.
    fn forward(&self, c2w: &Tensor, intrinsics: &Tensor, height: i64, width: i64) -> Tensor {
        let entry = |row: i64, column: i64| intrinsics.select(-2, row).select(-1, column);
        let (w, h) = (width as f64, height as f64);
        let features = [(entry(0, 0) / w).log(), (entry(1, 1) / h).log(), entry(0, 2) / w, entry(1, 2) / h];
        let features = Tensor::stack(&features, -1); // [B, V, 4]
        let intrinsics = gelu(self.intrinsics_in.forward(&features));
        let intrinsics = gelu(self.intrinsics_out.forward(&intrinsics));

        let center = c2w.narrow(-2, 0, 3).select(-1, 3); // [B, V, 3]
        let phases: Vec<Tensor> = FREQUENCIES.iter().map(|f| &center * (f * PI)).collect();
        let phases = Tensor::cat(&phases, -1); // frequency-major, xyz inside
        let code = Tensor::cat(&[intrinsics, center, phases.sin(), phases.cos()], -1); // [B, V, 64 + 27]
        self.project.forward(&code)
    }
}

/// Maximum number of views from which the mean token is estimated if views are computed one by one, where using all of them costs time.
const VIEWS_OF_MEAN: usize = 4;

/// Tokens that the slots attend to: learned tokens and the raw image tokens of all views, normalized (spec 4.1) and split into their mean and
/// the differences from it. Tokens are much alike: most of what a photo's patches encode of their rays and of their camera is the same for
/// all photos. If only the differences are rounded to 8 bits, scores distinguish thousands of patches as they do in float32.
#[derive(Debug)]
pub struct ImageTokens {
    /// Difference of each token from the mean, [B, m, token width].
    pub centered: Tensor,
    /// Mean of the tokens, or an estimate of it, [B, 1, token width] in float32, without gradients: the result doesn't depend on what is
    /// taken as the mean.
    pub mean: Tensor,
}

impl ImageTokens {
    /// Normalizes and centers `tokens` [B, m, token width] in float32. The gradients of all rounds flow back to them and are accumulated in
    /// float32.
    pub(crate) fn new(tokens: &Tensor) -> Self {
        let tokens = normalize_without_affine(tokens);
        trace_span!("norms").in_scope(|| {
            let mean = tokens.detach().mean_dim(1, true, None);
            ImageTokens { centered: tokens - &mean, mean }
        })
    }

    /// Builds the tokens from `registers` [1, r, token width] and `views` views, for products in `precision`. `view` computes the raw tokens
    /// of one view, [B, P, token width], and is called for one view after the other. All tokens in float32 would take much memory, so a few
    /// views are computed twice: their mean is close to that of all.
    pub(super) fn from_views(
        registers: &Tensor,
        views: i64,
        view: impl Fn(i64) -> Tensor,
        precision: Precision,
    ) -> Self {
        let view = |n| normalize_without_affine(&view(n));
        let few = (0..views).step_by((views as usize).div_ceil(VIEWS_OF_MEAN)).map(view);
        let mean_of_view = |t: &Tensor| trace_span!("norms").in_scope(|| t.mean_dim(1, false, None));
        let (sizes, means): (Vec<_>, Vec<_>) = few.map(|t| (t.size(), mean_of_view(&t))).unzip();
        let mean = Tensor::stack(&means, 1).mean_dim(1, true, None);

        let (batch, patches, width) = (sizes[0][0], sizes[0][1], sizes[0][2]);
        let learned = registers.size()[1];
        let size = [batch, learned + views * patches, width];
        let centered = Tensor::empty(size, (precision.kind(), mean.device()));
        let put = |first, of: Tensor| {
            trace_span!("norms").in_scope(|| centered.narrow(1, first, of.size()[1]).copy_(&(of - &mean)));
        };
        put(0, normalize_without_affine(registers));
        (0..views).for_each(|n| put(learned + n * patches, view(n)));
        ImageTokens { centered, mean }
    }

    /// Returns the tokens with their differences converted to `kind`.
    pub(super) fn to_kind(&self, kind: Kind) -> Self {
        ImageTokens { centered: self.centered.to_kind(kind), mean: self.mean.shallow_clone() }
    }

    /// Returns a detached copy that collects the gradients.
    pub(crate) fn leaf(&self) -> Self {
        ImageTokens { centered: leaf(&self.centered), mean: self.mean.shallow_clone() }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use tch::Device;

    /// Returns irregular values between −1 and 1 without random numbers; each `step` gives other values.
    pub(in super::super) fn uneven(step: f64, size: &[i64]) -> Tensor {
        let numbers = Tensor::arange(size.iter().product::<i64>(), (Kind::Double, Device::Cpu));
        (numbers.square() * step).sin().to_kind(Kind::Float).view(size)
    }

    /// Returns tokens [2, `count`, 24] that are close to one another.
    pub(in super::super) fn alike(count: i64) -> Tensor {
        uneven(0.7, &[24]) + 0.05 * uneven(1., &[2, count, 24])
    }

    #[test]
    fn views_make_the_same_tokens_one_by_one() {
        let registers = alike(2).get(0).unsqueeze(0);
        let from_views = |views: i64| {
            let tokens = alike(5 * views);
            let view = |n| tokens.narrow(1, 5 * n, 5);
            let all = Tensor::cat(&[&registers.expand([2, -1, -1], false), &tokens], 1);
            (ImageTokens::new(&all), ImageTokens::from_views(&registers, views, view, Precision::F32))
        };
        let largest = |t: Tensor| t.abs().max().double_value(&[]);
        for views in [1, 3, 9] {
            let (at_once, one_by_one) = from_views(views);
            let whole = |tokens: &ImageTokens| &tokens.centered + &tokens.mean;
            assert!(largest(whole(&at_once) - whole(&one_by_one)) < 1e-6, "{views} views");
            // A twentieth of each token is its own, by construction of `alike`.
            let [own, apart] = [&at_once, &one_by_one].map(|tokens| largest(tokens.centered.shallow_clone()));
            assert!(apart < 1.5 * own && apart < 0.2 * largest(whole(&at_once)), "{own} {apart}");
        }
    }
}
