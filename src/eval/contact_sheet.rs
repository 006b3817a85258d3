//! Contact sheets for visual inspection: ground truth, render and depth side by side.

use crate::data::View;
use crate::error::Result;
use crate::io::{Mosaic, colourize_depth, enlarge, shrink, subsample};
use crate::render::{RenderedView, render_views};
use crate::scene::Gaussians;
use std::path::Path;
use tch::Tensor;

/// Height in pixels that small images are enlarged to, or a little less.
const HEIGHT: i64 = 256;

/// A sheet with a row per view: photo, render, depth. Large images of many views are shrunk.
#[derive(Debug)]
pub struct ContactSheet(Mosaic);

impl ContactSheet {
    /// Creates a sheet for `views` rows.
    pub fn new(views: usize) -> Self {
        ContactSheet(Mosaic::column(views))
    }

    /// Renders `views` of Gaussians, and creates a sheet with a row for each.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn render(gaussians: &Gaussians, views: &[View]) -> Result<Self> {
        let mut sheet = ContactSheet::new(views.len());
        for view in views {
            sheet.add(&view.image.to_float(), &render_views(gaussians, &[view.camera])?[0].to_host())?;
        }
        Ok(sheet)
    }

    /// Adds the row of a view: the photo `ground_truth` `[3, H, W]`, and what was rendered from its camera.
    ///
    /// # Errors
    /// Fails if the images differ in size.
    pub fn add(&mut self, ground_truth: &Tensor, rendered: &RenderedView) -> Result<()> {
        let factor = self.0.factor(3, ground_truth);
        let [depth, alpha] = [&rendered.depth, &rendered.alpha].map(|numbers| subsample(numbers, factor));
        let [ground_truth, rgb] =
            [ground_truth, &rendered.rgb.clamp(0., 1.)].map(|image| shrink(image, factor));
        let images = [ground_truth, rgb, colourize_depth(&depth, &alpha)];
        self.0.add_shrunk(&images.map(|image| enlarge(&image, HEIGHT)))
    }

    /// Writes the sheet as a PNG. Returns the factor by which the sides of the largest images were divided: 1 if nothing was shrunk.
    ///
    /// # Errors
    /// Fails if the file can't be written.
    pub fn write(self, path: &Path) -> Result<i64> {
        let shrunk_by = self.0.shrunk_by();
        self.0.write(path)?;
        Ok(shrunk_by)
    }
}
