//! Comparison image of one view: ground truth, render, error and depth side by side.

use crate::io::{colourize_depth, shrink, shrink_factor, subsample, tile_horizontally};
use crate::render::RenderedView;
use tch::{Kind, Tensor};

/// Mean error over the channels from which on the brightest colour is used.
const FULL_ERROR: f64 = 0.25;

/// Maximum number of pixels of the whole image, which is displayed in a page.
const MAX_PIXELS: i64 = 1 << 24;

/// Returns the comparison image, `[3, H, W']` in [0, 1]. Large images are shrunk. The depth is left out if `rendered` is `None`.
pub(super) fn comparison_image(
    ground_truth: &Tensor,
    image: &Tensor,
    rendered: Option<&RenderedView>,
) -> Tensor {
    let size = image.size();
    let factor = shrink_factor(4 * size[1] * size[2], MAX_PIXELS);
    let (ground_truth, image) = (shrink(ground_truth, factor), shrink(&image.clamp(0., 1.), factor));
    let error = (&image - &ground_truth).abs().mean_dim([0i64].as_slice(), false, Kind::Float) / FULL_ERROR;
    // Colour map: black, red, yellow, white.
    let heat = Tensor::stack(&[&error * 3., &error * 3. - 1., &error * 3. - 2.], 0).clamp(0., 1.);
    let mut images = vec![ground_truth, image, heat];
    if let Some(rendered) = rendered {
        let [depth, alpha] = [&rendered.depth, &rendered.alpha].map(|numbers| subsample(numbers, factor));
        images.push(colourize_depth(&depth, &alpha));
    }
    tile_horizontally(&images)
}
