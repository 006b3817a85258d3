//! Tables of the report: measured beside published scores, the cost of a reconstruction, and the paper's model sizes and ablations.

use super::entries::{
    Entry, Row, absent, count, dataset_name, decimal, finite, rows, short, swatch, thousands, view_counts,
};
use super::plots;
use crate::eval::published::{IMAGE_SIZE, published};
use maud::{Markup, html};

/// Heading of a column, which is aligned like its cells.
pub enum Head {
    Text(&'static str),
    Number(&'static str),
}

/// Renders a table that scrolls on its own if it is wider than the screen.
pub fn table(caption: &str, head: &[Head], rows: Markup) -> Markup {
    html! {
        div.scroll tabindex="0" role="region" aria-label=(caption) {
            table.sortable {
                caption { (caption) }
                thead {
                    tr {
                        @for column in head {
                            @match column {
                                Head::Text(name) => th scope="col" { (name) },
                                Head::Number(name) => th.number scope="col" { (name) },
                            }
                        }
                    }
                }
                tbody { (rows) }
            }
        }
    }
}

/// Renders a cell with a number, or with the word for a missing value.
pub fn cell(value: Option<String>) -> Markup {
    html! { td.number { @match value { Some(text) => (text), None => (absent()) } } }
}

/// Renders the badge of a published row.
pub fn published_badge() -> Markup {
    html! { span.badge.published { "published" } }
}

/// Renders the badges of a measured row: its origin, and what makes its scores incomparable with published ones.
pub fn measured_badges(entry: &Entry) -> Markup {
    let [height, width] = entry.evaluation.image_size;
    html! {
        span.badge.measured { "measured here" }
        @if !entry.is_whole() { " " (partial_badge(entry)) }
        @if [height, width] != IMAGE_SIZE {
            " " span.badge.partial { (width) "×" (height) " pixels" }
        }
    }
}

/// Renders the badge of a mean that isn't over all scenes: the number of its scenes.
pub fn partial_badge(entry: &Entry) -> Markup {
    html! { span.badge.partial { (share(entry)) } }
}

/// Returns the number of scored scenes, as `2 of 5,601 scenes`.
pub fn share(entry: &Entry) -> String {
    let of = count(entry.evaluation.indexed_scenes, "scene");
    format!("{} of {of}", thousands(entry.scored() as u64))
}

/// Headings of the published scores.
pub const PSNR: Head = Head::Number("PSNR (dB)\u{a0}↑");
pub const SSIM: Head = Head::Number("SSIM\u{a0}↑");
const LPIPS: Head = Head::Number("LPIPS\u{a0}↓");

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
                        (plots::quality_by_views(entries, dataset))
                        (plots::distributions(entries, dataset))
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
    let gaussians = Head::Number("Gaussians (K)\u{a0}↓");
    let head = [Head::Text("Method"), Head::Text("Source"), PSNR, SSIM, LPIPS, gaussians];
    let table = table(&caption, &head, body);
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
                @if measured > 0 { (plots::quality_by_size(&rows, &caption)) }
            }
        }
    }
}

fn table_row(row: &Row) -> Markup {
    html! {
        tr.measured[row.measured.is_some()] {
            th scope="row" {
                @if let Some(entry) = row.measured { (swatch(entry.color)) }
                @if row.is_published_globalsplat() { strong { (row.name) } } @else { (row.name) }
            }
            td { @match row.measured { Some(entry) => (measured_badges(entry)), None => (published_badge()) } }
            (cell(row.scores.psnr.map(|v| decimal(v, 2))))
            (cell(row.scores.ssim.map(|v| decimal(v, 3))))
            (cell(row.scores.lpips.map(|v| decimal(v, 3))))
            (cell(row.scores.kilo_gaussians.map(short)))
        }
    }
}

const GIGA: f64 = 1e-9;
const MEGA: f64 = 1e-6;

/// Renders the table of time, memory and size, with published and measured rows, fastest first.
pub fn efficiency(entries: &[Entry]) -> Markup {
    let head = [
        Head::Text("Method"),
        Head::Text("Source"),
        Head::Text("Machine"),
        Head::Number("Context views"),
        Head::Number("Time (ms)\u{a0}↓"),
        Head::Number("GPU memory (GB)\u{a0}↓"),
        Head::Number("Host memory (GB)\u{a0}↓"),
        Head::Number("On disk (MB)\u{a0}↓"),
        Head::Number("Gaussians (K)\u{a0}↓"),
    ];
    let theirs = published().efficiency.iter().map(|row| {
        let markup = html! {
            tr {
                th scope="row" {
                    @if row.method.starts_with("GlobalSplat") { strong { (row.method) } } @else { (row.method) }
                }
                td { (published_badge()) }
                td.machine { "NVIDIA A100, 64 GB" }
                td.number { "24" }
                (cell(Some(decimal(row.milliseconds, 2))))
                (cell(Some(decimal(row.peak_memory_gb, 2))))
                (cell(None))
                (cell(row.disk_mb.map(short)))
                (cell(None))
            }
        };
        (row.milliseconds, markup)
    });
    let ours = entries.iter().filter_map(|entry| {
        let (evaluation, cost) = (entry.evaluation, entry.evaluation.efficiency?);
        let milliseconds = cost.forward_seconds * 1e3;
        let markup = html! {
            tr.measured {
                th scope="row" { (swatch(entry.color)) (entry.name) }
                td { (measured_badges(entry)) }
                td.machine { (evaluation.machine) }
                td.number { (evaluation.context_views) }
                td.number title={ "mean of " (count(cost.timed_scenes, "scene")) } {
                    (decimal(milliseconds, 2))
                }
                (cell(cost.peak_device_memory_bytes.map(|bytes| decimal(bytes as f64 * GIGA, 2))))
                (cell(Some(decimal(cost.peak_memory_bytes as f64 * GIGA, 2))))
                (cell(Some(short(cost.splat_bytes * MEGA))))
                (cell(evaluation.summary.gaussians.and_then(finite).map(|n| short(n * 1e-3))))
            }
        };
        Some((milliseconds, markup))
    });
    let mut rows: Vec<(f64, Markup)> = theirs.chain(ours).collect();
    rows.sort_by(|a, b| a.0.total_cmp(&b.0));
    let body = html! { @for (_, row) in &rows { (row) } };
    html! {
        section {
            h2 { "Efficiency" }
            p { "Time is the forward pass, or passes, from views in memory to Gaussians; the first scene's is discarded. Memory is the peak. "
                "Times of different machines don't compare." }
            (table("Cost of a reconstruction", &head, body))
        }
    }
}

/// Renders the paper's table of model sizes.
pub fn compactness() -> Markup {
    let head = [
        Head::Number("Gaussians"),
        Head::Number("Latents"),
        Head::Number("Gaussians of a latent"),
        PSNR,
        SSIM,
        LPIPS,
    ];
    let body = html! {
        @for row in &published().compactness {
            tr {
                th.number scope="row" { (thousands(row.gaussians.into())) }
                td.number { (thousands(row.latents.into())) }
                td.number { (row.splats_per_token) }
                (scores(row.psnr, row.ssim, row.lpips))
            }
        }
    };
    html! {
        section {
            h2 { "Compactness and quality " (published_badge()) }
            (table("GlobalSplat by its number of Gaussians, RealEstate10K", &head, body))
        }
    }
}

/// Renders the paper's table of ablations.
pub fn ablations() -> Markup {
    let head = [Head::Text("Variant"), PSNR, SSIM, LPIPS];
    let body = html! {
        @for row in &published().ablations {
            tr { th scope="row" { (row.variant) } (scores(row.psnr, row.ssim, row.lpips)) }
        }
    };
    html! {
        section {
            h2 { "Ablations " (published_badge()) }
            (table("GlobalSplat with one part changed, RealEstate10K", &head, body))
        }
    }
}

fn scores(psnr: f64, ssim: f64, lpips: f64) -> Markup {
    let cells = [(psnr, 2), (ssim, 3), (lpips, 3)];
    html! { @for (value, digits) in cells { (cell(Some(decimal(value, digits)))) } }
}
