//! Optimizes Gaussians to fit one photo, with the differentiable splat op, two losses and an optimizer:
//!
//!     cargo run --release --example fit_image -- photo.jpg fitted.png [STEPS]
//!
//! The output image shows the photo, the initial render, and the final render.

use globalsplat::data::{resize_and_crop, tensor_from_planes};
use globalsplat::io::{read_image, tile_horizontally, write_png};
use globalsplat::loss::{mse, ssim};
use globalsplat::metrics::psnr;
use globalsplat::optim::{Optimizer, ParameterGroup, UpdateRule};
use globalsplat::render::{Cameras, DEFAULT_EPS2D, render};
use globalsplat::scene::{Camera, ImageSize, Intrinsics, RawGaussians};
use globalsplat::{Error, Result};
use std::path::Path;
use tch::{Device, Kind, Tensor};

const GAUSSIANS: i64 = 4096;
/// Length of the image's longer side, in pixels.
const LONGEST_SIDE: f64 = 256.;
/// Weight of one minus SSIM relative to the mean squared error.
const SSIM_FACTOR: f64 = 0.02;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    let (photo, out, steps) = match arguments.as_slice() {
        [_, photo, out] => (photo, out, 500),
        [_, photo, out, steps] => {
            let expected = || Error::request(format!("STEPS is {steps}, expected a whole number"));
            (photo, out, steps.parse().map_err(|_| expected())?)
        }
        _ => return Err(Error::request("expected PHOTO OUT.png [STEPS]")),
    };
    let (photo, camera) = load(Path::new(photo))?;
    let cameras = Cameras::single(&camera);
    let gaussians = scattered(&camera);
    let mut optimizer = Optimizer::new(groups(&gaussians));

    // Renders an image [3, H, W], through which gradients flow back to every parameter of every Gaussian.
    let draw = || -> Result<Tensor> {
        let pictures = render(&gaussians.activate(), &cameras, DEFAULT_EPS2D)?;
        Ok(pictures.rgb.select(0, 0).select(0, 0))
    };
    let before = draw()?.detach();
    for _ in 0..steps {
        let picture = draw()?;
        let loss: Tensor = mse(&picture, &photo) + (1. - ssim(&picture, &photo)) * SSIM_FACTOR;
        optimizer.zero_grad();
        loss.backward();
        optimizer.step()?;
    }
    let after = draw()?.detach();
    println!("PSNR {:.2} dB, after {steps} steps {:.2} dB", psnr(&before, &photo), psnr(&after, &photo));
    write_png(Path::new(out), &tile_horizontally(&[photo, before.clamp(0., 1.), after.clamp(0., 1.)]))
}

/// Returns the photo [3, H, W], resized, and a camera of that size that looks along z.
fn load(path: &Path) -> Result<(Tensor, Camera)> {
    let image = read_image(path)?;
    let (width, height) = (f64::from(image.width()), f64::from(image.height()));
    let intrinsics = Intrinsics { fx: width, fy: width, cx: width / 2., cy: height / 2. };
    let camera =
        Camera { intrinsics, c2w: glam::DMat4::IDENTITY, width: image.width(), height: image.height() };
    let scale = LONGEST_SIDE / width.max(height);
    let side = |side: f64| ((side * scale).round() as u32).max(16);
    let (planes, camera) =
        resize_and_crop(&image, &camera, ImageSize { width: side(width), height: side(height) });
    Ok((tensor_from_planes(&planes), camera))
}

/// Returns round gray Gaussians scattered over the image, about one unit away, each about as large as their spacing.
fn scattered(camera: &Camera) -> RawGaussians {
    let options = (Kind::Float, Device::Cpu);
    let n = GAUSSIANS;
    tch::manual_seed(0);
    let uniform = || Tensor::rand([1, n, 1], options) - 0.5;
    // Width and height of the camera's view at distance 1.
    let (width, height) =
        (f64::from(camera.width) / camera.intrinsics.fx, f64::from(camera.height) / camera.intrinsics.fy);
    let spacing = (width * height / n as f64).sqrt();
    let leaf = |t: Tensor| t.set_requires_grad(true);
    RawGaussians {
        means: leaf(Tensor::cat(&[uniform() * width, uniform() * height, uniform() * 0.1 + 1.], -1)),
        log_scales: leaf(Tensor::full([1, n, 3], (0.5 * spacing).ln(), options)),
        quaternions: leaf(Tensor::from_slice(&[1f32, 0., 0., 0.]).expand([1, n, 4], false).contiguous()),
        opacity_logits: leaf(Tensor::zeros([1, n], options)),
        sh: leaf(Tensor::zeros([1, n, 1, 3], options)),
    }
}

/// Returns one parameter group per kind of parameter, since each needs its own learning rate.
fn groups(gaussians: &RawGaussians) -> Vec<ParameterGroup> {
    let learning_rate = |name: &str| match name {
        "means" => 1e-3,
        "log_scales" => 2e-2,
        _ => 3e-2,
    };
    let group = |(name, t): (&str, &Tensor)| ParameterGroup {
        rule: UpdateRule::AdamW,
        parameters: vec![(name.into(), t.shallow_clone())],
        learning_rate: learning_rate(name),
        weight_decay: 0.,
    };
    gaussians.named_parameters().map(group).into()
}
