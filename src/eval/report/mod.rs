//! Report: a self-contained HTML page that shows evaluations next to the paper's published results, without other files or network access.

mod entries;
mod plots;
mod scenes;
mod tables;

use super::evaluation::Evaluation;
use crate::error::{Error, Result};
use crate::io::{html_page, write_file};
use entries::{Entry, absent, count, dataset_name, decimal, entries, finite, swatch, thousands};
use maud::{Markup, PreEscaped, html};
use std::path::{Path, PathBuf};
use tables::{partial_badge, share};

const STYLE: &str = include_str!("style.css");
/// Script that sorts a table when a heading is clicked. The page is complete without it.
const SORTING: &str = include_str!("sorting.js");

/// Maximum number of failures of one evaluation that are listed openly; a longer list is collapsed.
const OPEN_FAILURES: usize = 20;

/// Writes the page that shows `evaluations` to `path`. Each evaluation comes with the folder that it was written to, which holds the
/// comparison images of its scenes.
///
/// # Errors
/// Fails if there is no evaluation, if an existing image can't be read, or if the file can't be written.
pub fn write_report(path: &Path, evaluations: &[(PathBuf, Evaluation)]) -> Result<()> {
    if evaluations.is_empty() {
        return Err(Error::request("a report shows one evaluation or more, found none"));
    }
    write_file(path, page(&entries(evaluations))?.into_string())
}

fn page(entries: &[Entry]) -> Result<Markup> {
    let title = title(entries);
    let body = html! {
        main {
            (heading(&title, entries))
            (failures(entries))
            (tables::comparisons(entries))
            (tables::efficiency(entries))
            div.halves { (tables::compactness()) (tables::ablations()) }
            (scenes::scenes(entries)?)
            footer {
                p { "Published rows are those of the GlobalSplat paper (Itkin et al.), as printed there. Its "
                    "numbers for NoPoSplat and AnySplat were first published by C3G, those for EcoSplat by "
                    "EcoSplat's authors." }
                p { "Written by globalsplat " (env!("CARGO_PKG_VERSION")) "." }
            }
        }
        script { (PreEscaped(SORTING)) }
    };
    Ok(html_page(&title, STYLE, &body))
}

/// Returns the title of the page.
fn title(entries: &[Entry]) -> String {
    match entries {
        [one] => format!("{} on {}", one.name, dataset_name(&one.dataset)),
        [first, rest @ ..] if rest.iter().all(|s| s.dataset == first.dataset) => {
            format!("{} evaluations on {}", entries.len(), dataset_name(&first.dataset))
        }
        _ => format!("{} evaluations", entries.len()),
    }
}

/// Renders the title, and a card for each evaluation.
fn heading(title: &str, entries: &[Entry]) -> Markup {
    html! {
        header {
            p.kicker { "Evaluation of novel views" }
            h1 { (title) }
        }
        section.cards aria-label="Means" { @for entry in entries { (card(entry)) } }
    }
}

fn card(entry: &Entry) -> Markup {
    let evaluation = entry.evaluation;
    let mean = evaluation.summary.mean;
    let [height, width] = evaluation.image_size;
    html! {
        article.card {
            h2 { (swatch(entry.color)) (entry.name) }
            p.setting {
                (entry.setting()) ", " (width) "×" (height) " pixels"
                @if !entry.is_whole() { " " (partial_badge(entry)) }
            }
            dl.tiles {
                (tile("PSNR", finite(mean.psnr).map(|v| decimal(v, 2)), "dB"))
                (tile("SSIM", finite(mean.ssim).map(|v| decimal(v, 4)), ""))
                (tile("LPIPS-VGG", mean.lpips_vgg.and_then(finite).map(|v| decimal(v, 4)), ""))
                @if mean.lpips_alex.is_some() {
                    (tile("LPIPS-Alex", mean.lpips_alex.and_then(finite).map(|v| decimal(v, 4)), ""))
                }
                (tile("Gaussians", evaluation.summary.gaussians.and_then(finite).map(|n| thousands(n.round() as u64)), ""))
            }
            p.fine {
                @if entry.is_whole() {
                    "Means over all " (count(entry.scored(), "scene")) " that " (evaluation.index) " names."
                } @else {
                    "Means over " (share(entry)) " that " (evaluation.index) " names, so not comparable to means "
                    "over all of them."
                }
                @if !evaluation.failures.is_empty() {
                    " " a href="#failures" { (count(evaluation.failures.len(), "scene")) " failed." }
                }
                " Computed on " (evaluation.machine) "."
            }
        }
    }
}

fn tile(name: &str, value: Option<String>, unit: &str) -> Markup {
    html! {
        div {
            dt { (name) }
            dd {
                @match value {
                    Some(text) => { (text) @if !unit.is_empty() { " " span.unit { (unit) } } }
                    None => (absent()),
                }
            }
        }
    }
}

/// Renders the list of scenes that couldn't be scored, with the reasons; nothing if there are none.
fn failures(entries: &[Entry]) -> Markup {
    let failed: Vec<_> = entries.iter().filter(|s| !s.evaluation.failures.is_empty()).collect();
    html! {
        @if !failed.is_empty() {
            section.failures id="failures" {
                h2 { "Scenes that failed" }
                @for entry in failed {
                    @let failures = &entry.evaluation.failures;
                    details open[failures.len() <= OPEN_FAILURES] {
                        summary { (entry.name) ", " (entry.setting()) ": " (count(failures.len(), "scene")) }
                        ul {
                            @for failure in failures { li { code { (failure.scene) } " " (failure.error) } }
                        }
                    }
                }
            }
        }
    }
}
