//! One view: truth, render, error and depth side by side.

use crate::io::{colourize_depth, shrink, shrink_factor, subsample, tile_horizontally};
use crate::render::Rendered;
use tch::{Kind, Tensor};

/// Mean errors from here on are shown in the brightest colour.
const FULL_ERROR: f64 = 0.25;

/// Pixels of the whole, which is looked at in a page.
const MOST_PIXELS: i64 = 1 << 24;

/// [3, H, W'] in [0, 1], shrunk where pictures are large; without the depth where nothing is known but the picture.
pub(super) fn comparison_image(truth: &Tensor, picture: &Tensor, rendered: Option<&Rendered>) -> Tensor {
    let size = picture.size();
    let factor = shrink_factor(4 * size[1] * size[2], MOST_PIXELS);
    let (truth, picture) = (shrink(truth, factor), shrink(&picture.clamp(0., 1.), factor));
    let error = (&picture - &truth).abs().mean_dim([0i64].as_slice(), false, Kind::Float) / FULL_ERROR;
    // Black, red, yellow, white.
    let heat = Tensor::stack(&[&error * 3., &error * 3. - 1., &error * 3. - 2.], 0).clamp(0., 1.);
    let mut pictures = vec![truth, picture, heat];
    if let Some(rendered) = rendered {
        let [depth, alpha] = [&rendered.depth, &rendered.alpha].map(|numbers| subsample(numbers, factor));
        pictures.push(colourize_depth(&depth, &alpha));
    }
    tile_horizontally(&pictures)
}
