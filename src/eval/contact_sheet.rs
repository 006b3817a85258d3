//! Truth, render and depth side by side: what a person looks at first.

use crate::data::View;
use crate::io::{colourize_depth, enlarge, tile_horizontally, tile_vertically};
use crate::render::Rendered;
use tch::Tensor;

/// Small pictures are enlarged to about this many pixels.
const HEIGHT: i64 = 256;

/// A row per view: photo, render, depth. [3, H', W'] in [0, 1].
pub fn contact_sheet(truth: &[View], rendered: &[Rendered]) -> Tensor {
    let row = |(view, r): (&View, &Rendered)| {
        let pictures = [view.image.shallow_clone(), r.rgb.clamp(0., 1.), colourize_depth(&r.depth, &r.alpha)];
        tile_horizontally(&pictures.map(|picture| enlarge(&picture, HEIGHT)))
    };
    tile_vertically(&truth.iter().zip(rendered).map(row).collect::<Vec<_>>())
}
