//! Head of the page: title, mean scores, and scenes that failed.

use super::entry::{Entry, dataset_name};
use super::numbers::{self, count, decimal, thousands};
use super::table::{partial_badge, share, swatch};
use maud::{Markup, html};

/// Maximum number of failures of one evaluation that are listed openly; a longer list is collapsed.
const OPEN_FAILURES: usize = 20;

/// Returns the title of the page.
pub fn title(entries: &[Entry]) -> String {
    match entries {
        [one] => format!("{} on {}", one.name, dataset_name(&one.dataset)),
        [first, rest @ ..] if rest.iter().all(|s| s.dataset == first.dataset) => {
            format!("{} evaluations on {}", entries.len(), dataset_name(&first.dataset))
        }
        _ => format!("{} evaluations", entries.len()),
    }
}

/// Renders the title, and a card for each evaluation.
pub fn heading(title: &str, entries: &[Entry]) -> Markup {
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
            h2 { (swatch(entry)) (entry.name) }
            p.setting {
                (entry.setting()) ", " (width) "×" (height) " pixels"
                @if !entry.is_whole() { " " (partial_badge(entry)) }
            }
            dl.tiles {
                (tile("PSNR", numbers::mean(mean.psnr).map(|v| decimal(v, 2)), "dB"))
                (tile("SSIM", numbers::mean(mean.ssim).map(|v| decimal(v, 4)), ""))
                (tile("LPIPS-VGG", mean.lpips_vgg.and_then(numbers::mean).map(|v| decimal(v, 4)), ""))
                @if mean.lpips_alex.is_some() {
                    (tile("LPIPS-Alex", mean.lpips_alex.and_then(numbers::mean).map(|v| decimal(v, 4)), ""))
                }
                (tile("Gaussians", evaluation.summary.gaussians.and_then(numbers::mean).map(|n| thousands(n.round() as u64)), ""))
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
                    None => (numbers::absent()),
                }
            }
        }
    }
}

/// Renders the list of scenes that couldn't be scored, with the reasons; nothing if there are none.
pub fn failures(entries: &[Entry]) -> Markup {
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
