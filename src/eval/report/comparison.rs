//! Measured rows among the published ones: a table for each data set and number of context views.

use super::entry::{Entry, dataset_name};
use super::numbers::{self, count, decimal, short};
use super::plot;
use super::table::{Head, cell, measured_badges, published_badge, swatch, table};
use crate::eval::published::published;
use maud::{Markup, html};
use std::collections::BTreeSet;

const HEAD: [Head; 6] = [
    Head::Text("Method"),
    Head::Text("Source"),
    Head::Number("PSNR (dB)\u{a0}↑"),
    Head::Number("SSIM\u{a0}↑"),
    Head::Number("LPIPS\u{a0}↓"),
    Head::Number("Gaussians (K)\u{a0}↓"),
];

/// A row of a comparison.
pub struct Row<'a> {
    pub name: &'a str,
    /// `None` where the paper has it.
    pub measured: Option<&'a Entry<'a>>,
    pub psnr: Option<f64>,
    pub ssim: Option<f64>,
    pub lpips: Option<f64>,
    pub kilo_gaussians: Option<f64>,
}

impl Row<'_> {
    /// Whether it is the paper's own method, as published.
    pub fn is_published_globalsplat(&self) -> bool {
        self.measured.is_none() && self.name.starts_with("GlobalSplat")
    }
}

/// Everything known of one data set and number of context views, best PSNR first.
pub fn rows<'a>(entries: &'a [Entry<'a>], dataset: &str, views: usize) -> Vec<Row<'a>> {
    let methods = published().novel_views.iter().filter(|method| method.dataset == dataset);
    let theirs = methods.filter_map(|method| {
        let scores = method.scores.get(&views)?;
        Some(Row {
            name: &method.method,
            measured: None,
            psnr: scores.psnr,
            ssim: scores.ssim,
            lpips: scores.lpips,
            kilo_gaussians: scores.kilo_gaussians,
        })
    });
    let measured = entries.iter().filter(|s| s.dataset == dataset && s.evaluation.context_views == views);
    let ours = measured.map(|entry| {
        let mean = entry.evaluation.summary;
        Row {
            name: &entry.name,
            measured: Some(entry),
            psnr: numbers::mean(mean.psnr),
            ssim: numbers::mean(mean.ssim),
            lpips: mean.lpips_vgg.and_then(numbers::mean),
            kilo_gaussians: mean.gaussians.and_then(numbers::mean).map(|n| n * 1e-3),
        }
    });
    let mut rows: Vec<Row> = theirs.chain(ours).collect();
    let order = |row: &Row| row.psnr.unwrap_or(f64::NEG_INFINITY);
    rows.sort_by(|a, b| order(b).total_cmp(&order(a)));
    rows
}

/// A section for each data set, those with something measured first.
pub fn comparisons(entries: &[Entry]) -> Markup {
    let mut datasets: Vec<&str> = vec!["re10k", "acid"];
    for entry in entries {
        if !datasets.contains(&entry.dataset.as_str()) {
            datasets.push(&entry.dataset);
        }
    }
    let measured = |dataset: &str| entries.iter().any(|entry| entry.dataset == dataset);
    datasets.sort_by_key(|dataset| !measured(dataset));
    html! {
        @for dataset in datasets {
            section.comparison {
                h2 { (dataset_name(dataset)) }
                @if measured(dataset) {
                    p {
                        "Sorted by PSNR. LPIPS measured here is by VGG-16. A mean over a part of the scenes doesn't "
                        "compare to the published ones."
                    }
                    div.plots {
                        (plot::quality_by_views(entries, dataset))
                        (plot::distributions(entries, dataset))
                    }
                }
                @for views in view_counts(entries, dataset) { (comparison(entries, dataset, views)) }
            }
        }
    }
}

/// Numbers of context views that were published or measured.
pub fn view_counts(entries: &[Entry], dataset: &str) -> BTreeSet<usize> {
    let methods = published().novel_views.iter().filter(|method| method.dataset == dataset);
    let theirs = methods.flat_map(|method| method.scores.keys().copied());
    let ours = entries.iter().filter(|s| s.dataset == dataset).map(|s| s.evaluation.context_views);
    theirs.chain(ours).collect()
}

fn comparison(entries: &[Entry], dataset: &str, views: usize) -> Markup {
    let rows = rows(entries, dataset, views);
    let measured = rows.iter().filter(|row| row.measured.is_some()).count();
    let caption = format!("{}, {}", dataset_name(dataset), count(views, "context view"));
    let body = html! { @for row in &rows { (table_row(row)) } };
    let table = table(&caption, &HEAD, body);
    let published = rows.len() - measured;
    html! {
        // What nothing was measured for is there for reference, and stays out of the way.
        details.views open[measured > 0] {
            summary {
                h3 { (count(views, "context view")) }
                span.fine { (measured) " measured, " (published) " published" }
            }
            div.beside[measured > 0] {
                (table)
                @if measured > 0 { (plot::quality_by_size(&rows, &caption)) }
            }
        }
    }
}

fn table_row(row: &Row) -> Markup {
    html! {
        tr.measured[row.measured.is_some()] {
            th scope="row" {
                @if let Some(entry) = row.measured { (swatch(entry)) }
                @if row.is_published_globalsplat() { strong { (row.name) } } @else { (row.name) }
            }
            td { @match row.measured { Some(entry) => (measured_badges(entry)), None => (published_badge()) } }
            (cell(row.psnr.map(|v| decimal(v, 2))))
            (cell(row.ssim.map(|v| decimal(v, 3))))
            (cell(row.lpips.map(|v| decimal(v, 3))))
            (cell(row.kilo_gaussians.map(short)))
        }
    }
}
