//! Truth, render and depth side by side: what a person looks at first.

use crate::error::Result;
use crate::io::{Mosaic, colourize_depth, enlarge, shrink, subsample};
use crate::render::Rendered;
use std::path::Path;
use tch::Tensor;

/// Small pictures are enlarged to about this many pixels.
const HEIGHT: i64 = 256;

/// A row per view: photo, render, depth. Large pictures of many views are shrunk.
#[derive(Debug)]
pub struct ContactSheet(Mosaic);

impl ContactSheet {
    /// Begins a sheet of `views` rows.
    pub fn new(views: usize) -> Self {
        ContactSheet(Mosaic::column(views))
    }

    /// Adds the row of a photo, `truth` [3, H, W], and what was rendered from its camera.
    ///
    /// # Errors
    /// libtorch's refusal of pictures of different sizes.
    pub fn add(&mut self, truth: &Tensor, rendered: &Rendered) -> Result<()> {
        let factor = self.0.factor(3, truth);
        let [depth, alpha] = [&rendered.depth, &rendered.alpha].map(|numbers| subsample(numbers, factor));
        let [truth, rgb] = [truth, &rendered.rgb.clamp(0., 1.)].map(|picture| shrink(picture, factor));
        let pictures = [truth, rgb, colourize_depth(&depth, &alpha)];
        self.0.add_shrunk(&pictures.map(|picture| enlarge(&picture, HEIGHT)))
    }

    /// Writes the sheet as a PNG, and returns by how much the sides of the largest pictures were divided: 1 where nothing was shrunk.
    ///
    /// # Errors
    /// The system's refusal to write.
    pub fn write(self, path: &Path) -> Result<i64> {
        let shrunk_by = self.0.shrunk_by();
        self.0.write(path)?;
        Ok(shrunk_by)
    }
}
