//! Scores of a splat on views, computed one view at a time.

use super::method::score_with_lpips;
use super::perceptual::Perceptual;
use super::scores::{CaptureScores, score};
use crate::data::View;
use crate::error::Result;
use crate::render::render_views;
use crate::scene::Gaussians;

/// Scores a splat on `views`, including LPIPS if `perceptual` is given. `should_continue` is called before each view with the number of
/// finished views. If it returns `false`, the means are over the finished views. Returns `None` if no view is finished.
///
/// # Errors
/// Fails if the rasterizer fails.
pub fn score_views(
    scene: &str,
    gaussians: &Gaussians,
    views: &[View],
    perceptual: Option<&Perceptual>,
    mut should_continue: impl FnMut(usize) -> bool,
) -> Result<Option<CaptureScores>> {
    let mut done = vec![];
    for view in views {
        if !should_continue(done.len()) {
            break;
        }
        let images = [render_views(gaussians, &[view.camera])?.remove(0).rgb];
        let ground_truth = [view.shallow_clone()];
        let scores = match perceptual {
            Some(perceptual) => score_with_lpips(scene, &images, &ground_truth, None, perceptual),
            None => score(scene, &images, &ground_truth, None),
        };
        done.extend(scores?.views);
    }
    Ok((!done.is_empty()).then(|| CaptureScores::from_views(scene, done, Some(gaussians.count()))))
}
