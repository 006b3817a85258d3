//! Cost of a reconstruction, and the paper's tables of model sizes and ablations.

use super::entry::Entry;
use super::numbers::{self, decimal, short, thousands};
use super::table::{Head, cell, measured_badges, published_badge, swatch, table};
use crate::eval::published::published;
use maud::{Markup, html};

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
                th scope="row" { (swatch(entry)) (entry.name) }
                td { (measured_badges(entry)) }
                td.machine { (evaluation.machine) }
                td.number { (evaluation.context_views) }
                td.number title={ "mean of " (numbers::count(cost.timed_scenes, "scene")) } {
                    (decimal(milliseconds, 2))
                }
                (cell(cost.peak_device_memory_bytes.map(|bytes| decimal(bytes as f64 * GIGA, 2))))
                (cell(Some(decimal(cost.peak_memory_bytes as f64 * GIGA, 2))))
                (cell(Some(short(cost.splat_bytes * MEGA))))
                (cell(evaluation.summary.gaussians.and_then(numbers::mean).map(|n| short(n * 1e-3))))
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
        Head::Number("PSNR (dB)\u{a0}↑"),
        Head::Number("SSIM\u{a0}↑"),
        Head::Number("LPIPS\u{a0}↓"),
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
    let head = [
        Head::Text("Variant"),
        Head::Number("PSNR (dB)\u{a0}↑"),
        Head::Number("SSIM\u{a0}↑"),
        Head::Number("LPIPS\u{a0}↓"),
    ];
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
