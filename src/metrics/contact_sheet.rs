//! Images for visual inspection: ground truth, render and depth side by side, of many views or of one.

use crate::data::View;
use crate::error::Result;
use crate::io::{Mosaic, enlarge, shrink, shrink_factor, subsample, tile_horizontally};
use crate::render::{RenderedView, colorize_depth, render_views};
use crate::scene::Gaussians;
use std::path::Path;
use tch::{Kind, Tensor};

/// Height in pixels that small images are enlarged to, or a little less.
const HEIGHT: i64 = 256;

/// Mean error over the channels from which on the brightest color is used.
const FULL_ERROR: f64 = 0.25;

/// Maximum number of pixels of a comparison image, which is displayed in a page.
const MAX_PIXELS: i64 = 1 << 24;

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
        let images = [ground_truth, rgb, colorize_depth(&depth, &alpha)];
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

/// Returns the comparison image of a view, `[3, H, W']` in [0, 1]: the photo, the image, its error and the depth side by side. Large images
/// are shrunk. The depth is left out if `rendered` is `None`.
pub fn comparison_image(ground_truth: &Tensor, image: &Tensor, rendered: Option<&RenderedView>) -> Tensor {
    let size = image.size();
    let factor = shrink_factor(4 * size[1] * size[2], MAX_PIXELS);
    let (ground_truth, image) = (shrink(ground_truth, factor), shrink(&image.clamp(0., 1.), factor));
    let error = (&image - &ground_truth).abs().mean_dim([0i64].as_slice(), false, Kind::Float) / FULL_ERROR;
    // Color map: black, red, yellow, white.
    let heat = Tensor::stack(&[&error * 3., &error * 3. - 1., &error * 3. - 2.], 0).clamp(0., 1.);
    let mut images = vec![ground_truth, image, heat];
    if let Some(rendered) = rendered {
        let [depth, alpha] = [&rendered.depth, &rendered.alpha].map(|numbers| subsample(numbers, factor));
        images.push(colorize_depth(&depth, &alpha));
    }
    tile_horizontally(&images)
}
