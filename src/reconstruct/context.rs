//! Selection of the context views of a capture that a model sees.

use super::spread::spread_over_path;
use crate::data::{Capture, Holdout, View, load_views};
use crate::error::Result;
use crate::scene::ImageSize;

/// Loads the context views of a capture, fitted to `size`: the views that `holdout` doesn't hold out. If `views` is given, at most so many
/// of them are loaded, spread over the camera path.
///
/// # Errors
/// Fails if a photo can't be read.
pub fn load_context(
    capture: &Capture,
    holdout: Holdout,
    views: Option<usize>,
    size: ImageSize,
) -> Result<Vec<View>> {
    load_views(capture, &context_views(capture, holdout, views), Some(size))
}

/// Returns the indices of the views that [`load_context`] loads.
pub fn context_views(capture: &Capture, holdout: Holdout, views: Option<usize>) -> Vec<usize> {
    let (shown, _) = capture.split(holdout);
    match views {
        Some(views) => spread_over_path(&capture.cameras(), &shown, views),
        None => shown,
    }
}
