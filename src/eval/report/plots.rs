//! Plots as SVG: quality by the number of context views and by size, and the distribution over scenes.

use super::entries::{Entry, Row, count, dataset_name, decimal, finite, rows, short, swatch, view_counts};
use maud::{Markup, PreEscaped, html};
use plotters::coord::types::RangedCoordf64;
use plotters::drawing::DrawingAreaErrorKind;
use plotters::prelude::*;
use std::ops::Range;

/// Width and height of a plot in its own pixels, which the page scales.
const SIZE: (u32, u32) = (560, 340);
/// Possible widths of a histogram's bin in dB, and the maximum number of bins.
const BIN_WIDTHS: [f64; 5] = [0.2, 0.5, 1., 2., 5.];
const MAX_BINS: f64 = 28.;

type Chart<'a> = ChartContext<'a, SVGBackend<'a>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;
type Drawn = Result<(), DrawingAreaErrorKind<std::io::Error>>;

/// An axis: its title, its range, and the text of a tick.
struct Axis<'a> {
    title: &'a str,
    range: Range<f64>,
    tick: &'a dyn Fn(f64) -> String,
}

/// Points of one method.
struct Series<'a> {
    name: &'a str,
    color: RGBColor,
    is_measured: bool,
    points: Vec<(f64, f64)>,
}

impl<'a> Series<'a> {
    fn new(row: &Row<'a>, point: (f64, f64)) -> Self {
        Series { name: row.name, color: row.color, is_measured: row.measured.is_some(), points: vec![point] }
    }
}

/// Draws the axes, and then what `draw` adds, into an SVG.
fn plot(x: Axis, y: Axis, draw: impl for<'a> FnOnce(&mut Chart<'a>) -> Drawn) -> String {
    let mut svg = String::new();
    let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
    let draw_all = || -> Drawn {
        area.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&area)
            .margin(14)
            .x_label_area_size(46)
            .y_label_area_size(56)
            .build_cartesian_2d(x.range, y.range)?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .x_labels(6)
            .y_labels(6)
            .x_desc(x.title)
            .y_desc(y.title)
            .x_label_formatter(&|value| (x.tick)(*value))
            .y_label_formatter(&|value| (y.tick)(*value))
            .draw()?;
        draw(&mut chart)?;
        area.present()
    };
    draw_all().expect("a string can always be written");
    drop(area);
    svg
}

/// Returns whole numbers that enclose `values`.
fn enclose(values: impl Iterator<Item = f64> + Clone) -> Range<f64> {
    let first = values.clone().fold(f64::INFINITY, f64::min).floor();
    first..values.fold(first, f64::max).ceil().max(first + 1.)
}

fn psnr_axis<'a>(values: impl Iterator<Item = f64> + Clone) -> Axis<'a> {
    Axis { title: "PSNR (dB)", range: enclose(values), tick: &short }
}

/// Renders a figure: title, plot, legend. `about` describes the plot for screen readers.
fn figure(title: &str, about: &str, svg: &str, legend: Markup) -> Markup {
    // Within a page, an SVG needs no namespace.
    let svg = svg.replacen(" xmlns=\"http://www.w3.org/2000/svg\"", "", 1);
    html! {
        figure.plot {
            figcaption { (title) }
            div.scroll tabindex="0" role="region" aria-label=(title) {
                div role="img" aria-label=(about) { (PreEscaped(svg)) }
            }
            ul.legend { (legend) }
        }
    }
}

/// Renders the points of methods by `x`, joined by lines, with a legend of their names. Published points are hollow.
fn methods(title: &str, about: &str, x: Axis, mut series: Vec<Series>) -> Markup {
    // Measured points are drawn last, on top of the others.
    series.sort_by_key(|series| series.is_measured);
    let y = psnr_axis(series.iter().flat_map(|series| series.points.iter().map(|point| point.1)));
    let svg = plot(x, y, |chart| {
        for Series { color, is_measured, points, .. } in &series {
            let (width, radius) = if *is_measured { (3, 6) } else { (1, 4) };
            let style = if *is_measured { color.filled() } else { color.stroke_width(2) };
            chart.draw_series(LineSeries::new(points.clone(), color.stroke_width(width)))?;
            chart.draw_series(points.iter().map(|&point| Circle::new(point, radius, style)))?;
        }
        Ok(())
    });
    let legend = html! {
        @for series in series.iter().rev() {
            li { (swatch(series.color)) (series.name) @if series.is_measured { ", measured here" } }
        }
    };
    figure(title, about, &svg, legend)
}

/// Plots PSNR against the number of context views, a line for each method: the benefit of more photos. Renders nothing if there is only one
/// number of views.
pub fn quality_by_views(entries: &[Entry], dataset: &str) -> Markup {
    let counts = view_counts(entries, dataset);
    let (Some(&fewest), Some(&most)) = (counts.first(), counts.last()) else { return html! {} };
    if fewest == most {
        return html! {};
    }
    let by_views: Vec<_> = counts.iter().map(|&views| (views, rows(entries, dataset, views))).collect();
    let mut series: Vec<Series> = vec![];
    for (views, row) in by_views.iter().flat_map(|(views, rows)| rows.iter().map(move |row| (*views, row))) {
        let Some(psnr) = row.scores.psnr else { continue };
        let point = (views as f64, psnr);
        let is_same =
            |series: &&mut Series| series.name == row.name && series.is_measured == row.measured.is_some();
        match series.iter_mut().find(is_same) {
            Some(series) => series.points.push(point),
            None => series.push(Series::new(row, point)),
        }
    }
    let range = fewest as f64 - 1. ..most as f64 + 1.;
    let x = Axis { title: "Context views", range, tick: &short };
    let dataset = dataset_name(dataset);
    let about = format!(
        "PSNR against the number of context views on {dataset}; the numbers are in the tables below."
    );
    methods(&format!("Quality by context views: {dataset}"), &about, x, series)
}

/// Plots PSNR against the number of Gaussians: the quality that a method achieves for its size. Renders nothing if no measured row has both,
/// or if there is only one point.
pub fn quality_by_size(rows: &[Row], setting: &str) -> Markup {
    let point = |row: &Row| Some(((row.scores.kilo_gaussians? * 1e3).max(1.).log10(), row.scores.psnr?));
    let series = rows.iter().filter_map(|row| Some(Series::new(row, point(row)?)));
    let series: Vec<Series> = series.collect();
    if series.len() < 2 || !series.iter().any(|series| series.is_measured) {
        return html! {};
    }
    let x = Axis {
        title: "Gaussians, logarithmic",
        range: enclose(series.iter().map(|series| series.points[0].0)),
        tick: &|exponent| match 10f64.powf(exponent) {
            count if count >= 1e6 => format!("{}M", short(count * 1e-6)),
            count if count >= 1e3 => format!("{}K", short(count * 1e-3)),
            count => short(count),
        },
    };
    let about =
        format!("PSNR against the number of Gaussians, {setting}; the numbers are in the table beside it.");
    methods(&format!("Quality by size: {setting}"), &about, x, series)
}

/// Plots the distribution of the scenes' PSNR: a histogram for each evaluation on `dataset`, all with the same bins.
pub fn distributions(entries: &[Entry], dataset: &str) -> Markup {
    let entries = entries.iter().filter(|entry| entry.dataset == dataset && entry.scored() > 0);
    let scenes = entries.clone().flat_map(|entry| &entry.evaluation.scenes);
    let Range { start, end } = enclose(scenes.map(|scene| scene.scores.mean.psnr));
    let width = BIN_WIDTHS.into_iter().find(|width| (end - start) / width <= MAX_BINS).unwrap_or(10.);
    let bins = ((end - start) / width).ceil() as usize;
    html! { @for entry in entries { (histogram(entry, start, bins, width)) } }
}

fn histogram(entry: &Entry, start: f64, bins: usize, width: f64) -> Markup {
    let mut counts = vec![0; bins];
    for scene in &entry.evaluation.scenes {
        let bin = ((scene.scores.mean.psnr - start) / width) as usize;
        counts[bin.min(bins - 1)] += 1;
    }
    let highest = counts.iter().copied().max().map_or(0., f64::from).max(5.);
    let edge = |bin: usize| start + bin as f64 * width;
    let x = Axis { title: "PSNR of a scene (dB)", range: start..edge(bins), tick: &short };
    let y = Axis { title: "Scenes", range: 0. ..highest, tick: &short };
    let mean = entry.evaluation.summary.mean.psnr;
    let svg = plot(x, y, |chart| {
        let bar = |(bin, &count): (usize, &i32)| {
            Rectangle::new([(edge(bin), 0.), (edge(bin + 1), f64::from(count))], entry.color.filled())
        };
        chart.draw_series(counts.iter().enumerate().map(bar))?;
        let at_mean = finite(mean).map(|mean| PathElement::new([(mean, 0.), (mean, highest)], BLACK));
        chart.draw_series(at_mean)?;
        Ok(())
    });
    let (scenes, mean) = (count(entry.scored(), "scene"), decimal(mean, 2));
    let legend = html! {
        li { (swatch(entry.color)) (scenes) " in steps of " (short(width)) " dB, mean " (mean) " dB" }
    };
    let views = count(entry.evaluation.context_views, "context view");
    let title = format!("From scene to scene: {}, {views}", entry.name);
    let about = format!("Histogram of PSNR. {title}: mean {mean} dB over {scenes}.");
    figure(&title, &about, &svg, legend)
}
