//! PSNR over the steps of a training run, for the training views and the held-out views.

use super::super::STYLE;
use super::super::numbers::decimal;
use super::axes::{Axis, Margins, bounds, frame, polyline};
use super::labels::spread;
use super::{HEIGHT, WIDTH, px};
use crate::error::{Error, Result};
use crate::io::write_atomically;
use crate::train::Curves;
use maud::{PreEscaped, html};
use std::path::Path;

const MARGINS: Margins = Margins::NAMED;
/// Maximum number of points of the training curve.
const MAX_POINTS: u64 = 60;

/// Draws the curves of the run in the folder `run` into `path`, a self-contained SVG. `nearest` is the score of showing the nearest photo,
/// for comparison.
///
/// # Errors
/// Fails if the metrics can't be read or the file can't be written.
pub fn write_curves(path: &Path, run: &Path, nearest: Option<f64>) -> Result<()> {
    let Curves { training, held_out } = Curves::read(run, MAX_POINTS)?;
    let last = training.iter().chain(&held_out).map(|point| point.0).fold(0, u64::max) as f64;
    let (worst, best) = bounds(training.iter().chain(&held_out).map(|point| point.1).chain(nearest));
    let x = Axis::linear(0., last, MARGINS.left, WIDTH - MARGINS.right);
    let y = Axis::linear(worst, best, HEIGHT - MARGINS.bottom, MARGINS.top);
    let lines = [("held out", "colour-2", held_out), ("in training", "colour-1", training)];
    let flat = nearest.map(|psnr| ("nearest photo", "published", vec![(0, psnr), (last as u64, psnr)]));
    let lines: Vec<_> = flat.into_iter().chain(lines).filter(|(_, _, points)| !points.is_empty()).collect();
    let ends: Vec<f64> = lines.iter().map(|(_, _, points)| y.pixel(points[points.len() - 1].1)).collect();
    let heights = spread(&ends, MARGINS.top, HEIGHT - MARGINS.bottom);
    let drawing = html! {
        svg xmlns="http://www.w3.org/2000/svg" viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } font-family="sans-serif" font-size="13" {
            style { (PreEscaped(STYLE)) }
            rect width="100%" height="100%" style="fill: var(--surface)" {}
            (frame(&x, &y, "Steps", "PSNR (dB)", |step| decimal(step, 0)))
            @for ((name, class, points), height) in lines.iter().zip(&heights) {
                polyline.line.(class) points=(polyline(points.iter().map(|&(step, psnr)| (step as f64, psnr)), &x, &y)) {}
                text.name x=(px(WIDTH - MARGINS.right + 8.)) y=(px(height + 4.)) {
                    (name) " " (decimal(points[points.len() - 1].1, 2))
                }
            }
        }
    };
    let text = drawing.into_string();
    write_atomically(path, |writer| writer.write_all(text.as_bytes()).map_err(Error::write(path)))
}
