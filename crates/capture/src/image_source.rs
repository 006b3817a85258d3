//! Images that don't come from files.

use image::RgbImage;
use std::fmt::Debug;

/// Source of a capture's images that computes them on request, for example by rendering a synthetic scene.
/// [`Capture::from_source`](crate::Capture::from_source) makes a capture of it.
pub trait ImageSource: Debug + Send + Sync {
    /// Returns what error messages call the images, for example "a synthetic video".
    fn name(&self) -> &str;

    /// Computes image `index`, at the size of its camera.
    fn image(&self, index: usize) -> RgbImage;

    /// Computes the depths of image `index` along its camera's axis at the pixel centers, row by row, in the unit of the poses. They
    /// are infinite in the sky. Returns `None` if the source doesn't know them.
    fn depth(&self, index: usize) -> Option<Vec<f32>>;
}
