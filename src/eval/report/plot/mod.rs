//! Plots as inline SVG. Their colours come from the page's style sheet, so that they follow the light and dark themes.

mod axes;
mod curves;
mod distribution;
mod labels;
mod quality_by_size;
mod quality_by_views;

pub use curves::write_curves;
pub use distribution::distributions;
pub use quality_by_size::quality_by_size;
pub use quality_by_views::quality_by_views;

use super::entry::Entry;
use super::table::swatch;
use maud::{Markup, html};

/// Width of a plot in its own pixels, which the page scales.
const WIDTH: f64 = 500.;
const HEIGHT: f64 = 340.;

/// Renders a figure: title, plot, legend. `about` describes the plot for screen readers.
fn figure(title: &str, about: &str, drawing: Markup, legend: Markup) -> Markup {
    html! {
        figure.plot {
            figcaption { (title) }
            div.scroll tabindex="0" role="region" aria-label=(title) {
                svg role="img" aria-label=(about) viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } { (drawing) }
            }
            ul.legend { (legend) }
        }
    }
}

/// Renders the legend of the colours that are in use.
fn legend<'a>(published: bool, globalsplat: bool, measured: impl Iterator<Item = &'a Entry<'a>>) -> Markup {
    html! {
        @if published { li { span.swatch.published aria-hidden="true" {} "published" } }
        @if globalsplat { li { span.swatch.paper aria-hidden="true" {} "published GlobalSplat" } }
        @for entry in measured { li { (swatch(entry)) (entry.name) ", measured here" } }
    }
}

/// Formats a coordinate, rounded to a tenth of a pixel.
fn px(value: f64) -> String {
    format!("{value:.1}")
}
