//! Distribution of the scenes' PSNR: one histogram for each evaluation, all with the same bins.

use super::super::entry::Entry;
use super::super::numbers::{count, decimal, short};
use super::super::table::swatch;
use super::axes::{Axis, Margins, bounds, frame};
use super::{HEIGHT, WIDTH, figure, px};
use maud::{Markup, html};

const MARGINS: Margins = Margins::NARROW;
/// Possible widths of a bin in dB, and the maximum number of bins.
const BIN_WIDTHS: [f64; 5] = [0.2, 0.5, 1., 2., 5.];
const MAX_BINS: f64 = 28.;

/// Renders one histogram for each evaluation on `dataset`.
pub fn distributions(entries: &[Entry], dataset: &str) -> Markup {
    let entries = entries.iter().filter(|entry| entry.dataset == dataset && entry.scored() > 0);
    let scenes = entries.clone().flat_map(|entry| &entry.evaluation.scenes);
    let (worst, best) = bounds(scenes.map(|scene| scene.scores.mean.psnr));
    let width = BIN_WIDTHS.into_iter().find(|width| (best - worst) / width <= MAX_BINS).unwrap_or(10.);
    let first = (worst / width).floor();
    html! {
        @for entry in entries {
            @let bins = ((best / width).floor() - first) as usize + 1;
            (histogram(entry, first, bins, width))
        }
    }
}

fn histogram(entry: &Entry, first: f64, bins: usize, width: f64) -> Markup {
    let mut counts = vec![0; bins];
    for scene in &entry.evaluation.scenes {
        let bin = (scene.scores.mean.psnr / width).floor() - first;
        counts[(bin as usize).min(bins - 1)] += 1;
    }
    let highest = counts.iter().copied().max().unwrap_or(0);
    let edge = |bin: usize| (first + bin as f64) * width;
    let x = Axis::linear(edge(0), edge(bins), MARGINS.left, WIDTH - MARGINS.right);
    let y = Axis::linear(0., f64::from(highest).max(5.), HEIGHT - MARGINS.bottom, MARGINS.top);
    let mean = entry.evaluation.summary.mean.psnr;
    let at = x.pixel(mean);
    let drawing = html! {
        (frame(&x, &y, "PSNR of a scene (dB)", "Scenes", |v| decimal(v, if v.fract() == 0. { 0 } else { 1 })))
        @for (bin, &number) in counts.iter().enumerate() {
            @if number > 0 {
                @let (left, right, top) = (x.pixel(edge(bin)), x.pixel(edge(bin + 1)), y.pixel(f64::from(number)));
                rect.bar.(entry.colour) x=(px(left + 0.5)) y=(px(top)) width=(px(right - left - 1.))
                    height=(px(y.pixel(0.) - top)) {
                    title { (decimal(edge(bin), 2)) " to " (decimal(edge(bin + 1), 2)) " dB: " (count(number as usize, "scene")) }
                }
            }
        }
        line.mean x1=(px(at)) x2=(px(at)) y1=(px(MARGINS.top - 8.)) y2=(px(y.pixel(0.))) {}
        text.name.emphasis.(if at > WIDTH * 0.75 { "end" } else { "start" })
            x=(px(if at > WIDTH * 0.75 { at - 6. } else { at + 6. })) y=(px(MARGINS.top - 10.)) { "mean " (decimal(mean, 2)) }
    };
    let step = short(width);
    let legend = html! {
        li { (swatch(entry)) (count(entry.scored(), "scene")) " in steps of " (step) " dB" }
    };
    let title = format!(
        "From scene to scene: {}, {}",
        entry.name,
        count(entry.evaluation.context_views, "context view")
    );
    let about = format!(
        "Histogram of PSNR. {title}: mean {} dB over {}.",
        decimal(mean, 2),
        count(entry.scored(), "scene")
    );
    figure(&title, &about, drawing, legend)
}
