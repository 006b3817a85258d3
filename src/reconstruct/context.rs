//! Which of a capture's views a model sees.

use super::spread::spread_over_path;
use crate::data::{Capture, Holdout, View};
use crate::error::Result;
use crate::scene::ImageSize;

/// The views that `holdout` leaves, or so many of them, spread over the camera's path, fitted to `size`.
///
/// # Errors
/// Photos that can't be read.
pub fn load_context(
    capture: &Capture,
    holdout: Holdout,
    views: Option<usize>,
    size: ImageSize,
) -> Result<Vec<View>> {
    capture.load(&context_views(capture, holdout, views), Some(size))
}

/// Returns the positions of the views that [`load_context`] loads.
pub fn context_views(capture: &Capture, holdout: Holdout, views: Option<usize>) -> Vec<usize> {
    let (shown, _) = capture.split(holdout);
    match views {
        Some(views) => spread_over_path(&capture.cameras(), &shown, views),
        None => shown,
    }
}
