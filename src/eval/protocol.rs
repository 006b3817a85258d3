//! Pictures against photos, view by view.

use super::metrics::{psnr, ssim};
use super::reconstruct::{Model, Reconstruction, reconstruct};
use crate::data::{Capture, Holdout, ImageSize, View, spread_over_path};
use crate::error::{Error, Result};
use crate::io::{LoadedModel, read_image, tensor_from_rgb};
use crate::model::Gaussians;
use crate::render::{Cameras, DEFAULT_EPS2D, render};
use crate::scene::Camera;
use serde::{Deserialize, Serialize};
use std::path::Path;
use tch::Tensor;

/// What a camera saw of a splat.
#[derive(Debug)]
pub struct Rendered {
    /// [3, H, W].
    pub rgb: Tensor,
    /// [H, W].
    pub alpha: Tensor,
    /// [H, W].
    pub depth: Tensor,
}

/// One view's scores.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ViewScore {
    /// As the capture names it.
    pub image: String,
    /// In dB.
    pub psnr: f64,
    /// As scikit-image's.
    pub ssim: f64,
    /// The distance by VGG-16's features, where its weights are at hand.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_vgg: Option<f64>,
    /// The distance by AlexNet's features, where its weights are at hand.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_alex: Option<f64>,
}

/// A capture's scores: means over its views, and each of them.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CaptureScores {
    /// The capture's name.
    pub scene: String,
    /// In dB, mean over the views.
    pub psnr: f64,
    /// Mean over the views.
    pub ssim: f64,
    /// Mean over the views, where every one has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_vgg: Option<f64>,
    /// Mean over the views, where every one has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_alex: Option<f64>,
    /// Number of Gaussians, where a splat was scored.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gaussians: Option<i64>,
    /// One by one.
    pub views: Vec<ViewScore>,
}

/// Scores pictures [3, H, W] against views of the same sizes, without LPIPS, which [`super::Perceptual`] adds.
///
/// # Errors
/// A picture of another size than its view.
pub fn score(
    scene: &str,
    pictures: &[Tensor],
    truth: &[View],
    gaussians: Option<i64>,
) -> Result<CaptureScores> {
    let mut views = vec![];
    for (picture, view) in pictures.iter().zip(truth) {
        if picture.size() != view.image.size() {
            let (found, expected) = (picture.size(), view.image.size());
            return Err(Error::Request(format!(
                "the picture for {} has shape {found:?}, expected {expected:?}",
                view.name
            )));
        }
        let (psnr, ssim) = (psnr(picture, &view.image), ssim(picture, &view.image));
        views.push(ViewScore { image: view.name.clone(), psnr, ssim, lpips_vgg: None, lpips_alex: None });
    }
    let mean = |value: fn(&ViewScore) -> f64| views.iter().map(value).sum::<f64>() / views.len() as f64;
    Ok(CaptureScores {
        scene: scene.to_string(),
        psnr: mean(|v| v.psnr),
        ssim: mean(|v| v.ssim),
        lpips_vgg: None,
        lpips_alex: None,
        gaussians,
        views,
    })
}

/// Renders a splat from each camera, which may differ in size.
///
/// # Errors
/// Those of [`render`].
pub fn render_views(gaussians: &Gaussians, cameras: &[Camera]) -> Result<Vec<Rendered>> {
    cameras
        .iter()
        .map(|camera| {
            let pictures = tch::no_grad(|| render(gaussians, &Cameras::single(camera), DEFAULT_EPS2D))?;
            let first = |t: Tensor| t.select(0, 0).select(0, 0);
            Ok(Rendered {
                rgb: first(pictures.rgb),
                alpha: first(pictures.alpha),
                depth: first(pictures.depth),
            })
        })
        .collect()
}

/// A splat in the capture's own world against all of its photos.
///
/// # Errors
/// Photos that can't be read.
pub fn score_splat(
    gaussians: &Gaussians,
    capture: &Capture,
) -> Result<(CaptureScores, Vec<View>, Vec<Rendered>)> {
    let views = capture.load_all(None)?;
    let rendered = render_views(gaussians, &capture.cameras())?;
    let scores = score(&capture.name, &colours(&rendered), &views, Some(gaussians.count()))?;
    Ok((scores, views, rendered))
}

/// A model on one capture: it sees the views that `holdout` leaves, or `views` of them spread over the camera's path, and is
/// asked for the others.
///
/// # Errors
/// Nothing held out, photos that can't be read, or whatever the reconstruction fails with.
pub fn score_model(
    loaded: &LoadedModel,
    capture: &Capture,
    holdout: Holdout,
    views: Option<usize>,
) -> Result<(CaptureScores, Vec<View>, Vec<Rendered>)> {
    let (context, held_out) = load_split(capture, holdout, views, loaded.config.data.image_size)?;
    let (reconstruction, rendered) = ask(loaded, &context, &held_out)?;
    let count = reconstruction.gaussians.count();
    let scores = score(&capture.name, &colours(&rendered), &held_out, Some(count))?;
    Ok((scores, held_out, rendered))
}

/// What a model that sees `context` takes the cameras of `target` to see.
pub(super) fn ask<'a>(
    model: impl Into<Model<'a>>,
    context: &[View],
    target: &[View],
) -> Result<(Reconstruction, Vec<Rendered>)> {
    let poses: Vec<_> = target.iter().map(|view| view.camera.c2w).collect();
    let reconstruction = reconstruct(model, context, &poses)?;
    let normalized = target.iter().zip(&reconstruction.target_poses);
    let cameras: Vec<Camera> = normalized.map(|(view, &c2w)| Camera { c2w, ..view.camera }).collect();
    let rendered = render_views(&reconstruction.gaussians, &cameras)?;
    Ok((reconstruction, rendered))
}

/// [3, H, W] each.
pub(super) fn colours(rendered: &[Rendered]) -> Vec<Tensor> {
    rendered.iter().map(|rendered| rendered.rgb.shallow_clone()).collect()
}

/// What answering with the context photo taken nearest (by camera centre) would score for the held-out views.
pub(super) fn nearest_context_baseline(
    scene: &str,
    context: &[View],
    held_out: &[View],
) -> Result<CaptureScores> {
    let centre = |view: &View| view.camera.c2w.w_axis.truncate();
    let nearest = |target: &View| {
        let distance = |view: &&View| centre(view).distance(centre(target));
        let view = context.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).expect("a context view");
        view.image.shallow_clone()
    };
    score(scene, &held_out.iter().map(nearest).collect::<Vec<_>>(), held_out, None)
}

/// Pictures that somebody else rendered: one in `folder` for every view, found by the name of the photo's file.
///
/// # Errors
/// A picture that is missing or has another size.
pub fn score_renders(folder: &Path, capture: &Capture) -> Result<(CaptureScores, Vec<View>, Vec<Tensor>)> {
    let views = capture.load_all(None)?;
    let stem =
        |view: &View| Path::new(&view.name).file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let pictures = views.iter().map(|view| read_picture(folder, &stem(view))).collect::<Result<Vec<_>>>()?;
    let scores = score(&capture.name, &pictures, &views, None)?;
    Ok((scores, views, pictures))
}

/// The picture `name` in `folder`, whatever its ending, [3, H, W].
pub(super) fn read_picture(folder: &Path, name: &str) -> Result<Tensor> {
    let candidates = ["png", "jpg", "jpeg"].map(|ending| folder.join(format!("{name}.{ending}")));
    match candidates.iter().find(|path| path.is_file()) {
        Some(path) => Ok(tensor_from_rgb(&read_image(path)?)),
        None => {
            let expected = candidates[0].display().to_string();
            Err(Error::input(folder, format!("the picture for {name}"), "absent", expected))
        }
    }
}

/// The views that `holdout` leaves, or so many of them, and those that it holds out, at `size`.
pub(super) fn load_split(
    capture: &Capture,
    holdout: Holdout,
    views: Option<usize>,
    size: ImageSize,
) -> Result<(Vec<View>, Vec<View>)> {
    let (mut context, held_out) = split_views(capture, holdout)?;
    if let Some(views) = views {
        context = spread_over_path(&capture.cameras(), &context, views);
    }
    Ok((capture.load(&context, Some(size))?, capture.load(&held_out, Some(size))?))
}

/// Positions of the views that `holdout` leaves, and of those that it holds out.
pub(super) fn split_views(capture: &Capture, holdout: Holdout) -> Result<(Vec<usize>, Vec<usize>)> {
    let (context, held_out) = holdout.split(capture.len());
    if held_out.is_empty() || context.len() < 2 {
        let split = format!("{} to show and {} to ask for", context.len(), held_out.len());
        let expected = "2 and 1 at least (--holdout or data.holdout, every:N)";
        return Err(Error::input(capture.file(), format!("the split by {holdout}"), split, expected));
    }
    Ok((context, held_out))
}
