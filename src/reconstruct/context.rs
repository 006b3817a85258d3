//! Selection of the context views of a capture that a model sees.

use super::spread::spread_over_path;
use crate::data::{Capture, Holdout, View, load_views};
use crate::error::{Error, Result};
use crate::scene::ImageSize;

/// Loads the context views of a capture, fitted to `size`: the views that `holdout` doesn't hold out. If `views` is given, at most so many
/// of them are loaded, spread over the camera path.
///
/// # Errors
/// Fails if a photo can't be read, or if every photo is masked out as a whole.
pub fn load_context(
    capture: &Capture,
    holdout: Holdout,
    views: Option<usize>,
    size: ImageSize,
) -> Result<Vec<View>> {
    let views = load_views(capture, &context_views(capture, holdout, views), Some(size))?;
    if views.iter().all(View::is_masked_out) {
        return Err(Error::input(
            capture.file(),
            "the masks",
            "no pixel that counts",
            "white where a photo counts",
        ));
    }
    Ok(views)
}

/// Returns the indices of the views that [`load_context`] loads.
pub fn context_views(capture: &Capture, holdout: Holdout, views: Option<usize>) -> Vec<usize> {
    let (shown, _) = capture.split(holdout);
    match views {
        Some(views) => spread_over_path(&capture.cameras(), &shown, views),
        None => shown,
    }
}
