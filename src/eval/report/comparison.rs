//! Tables that compare measured and published scores: one for each dataset and number of context views.

use super::entry::{Entry, dataset_name};
use super::numbers::{count, decimal, short};
use super::plot;
use super::rows::{Row, rows, view_counts};
use super::table::{Head, cell, measured_badges, published_badge, swatch, table};
use maud::{Markup, html};

const HEAD: [Head; 6] = [
    Head::Text("Method"),
    Head::Text("Source"),
    Head::Number("PSNR (dB)\u{a0}↑"),
    Head::Number("SSIM\u{a0}↑"),
    Head::Number("LPIPS\u{a0}↓"),
    Head::Number("Gaussians (K)\u{a0}↓"),
];

/// Renders a section for each dataset. Datasets with measured scores come first.
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

fn comparison(entries: &[Entry], dataset: &str, views: usize) -> Markup {
    let rows = rows(entries, dataset, views);
    let measured = rows.iter().filter(|row| row.measured.is_some()).count();
    let caption = format!("{}, {}", dataset_name(dataset), count(views, "context view"));
    let body = html! { @for row in &rows { (table_row(row)) } };
    let table = table(&caption, &HEAD, body);
    let published = rows.len() - measured;
    html! {
        // Tables without measured scores are there for reference, so they are collapsed.
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
