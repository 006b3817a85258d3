//! Truth, render and depth side by side: what a person looks at first.

use super::protocol::Rendered;
use crate::data::View;
use crate::io::{colourize_depth, tile_horizontally, tile_vertically};
use tch::Tensor;

/// A row per view: photo, render, depth. [3, H', W'] in [0, 1]. The views have one size.
pub fn contact_sheet(truth: &[View], rendered: &[Rendered]) -> Tensor {
    let row = |(view, r): (&View, &Rendered)| {
        tile_horizontally(&[
            view.image.shallow_clone(),
            r.rgb.clamp(0., 1.),
            colourize_depth(&r.depth, &r.alpha),
        ])
    };
    tile_vertically(&truth.iter().zip(rendered).map(row).collect::<Vec<_>>())
}
