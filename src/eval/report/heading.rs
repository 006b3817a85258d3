//! What the page is about, the means at a glance, and what failed.

use super::numbers::{count, decimal, thousands};
use super::subject::{Subject, dataset_name};
use super::table::{partial_badge, share, swatch};
use maud::{Markup, html};

/// Failures of one evaluation that are listed openly; a longer list is folded.
const OPEN_FAILURES: usize = 20;

/// Of the page.
pub fn title(subjects: &[Subject]) -> String {
    match subjects {
        [one] => format!("{} on {}", one.name, dataset_name(&one.dataset)),
        [first, rest @ ..] if rest.iter().all(|s| s.dataset == first.dataset) => {
            format!("{} evaluations on {}", subjects.len(), dataset_name(&first.dataset))
        }
        _ => format!("{} evaluations", subjects.len()),
    }
}

/// Title, and a card for each evaluation.
pub fn heading(title: &str, subjects: &[Subject]) -> Markup {
    html! {
        header {
            p.kicker { "Evaluation of novel views" }
            h1 { (title) }
        }
        section.cards aria-label="Means" { @for subject in subjects { (card(subject)) } }
    }
}

fn card(subject: &Subject) -> Markup {
    let evaluation = subject.evaluation;
    let mean = evaluation.summary;
    let [height, width] = evaluation.image_size;
    html! {
        article.card {
            h2 { (swatch(subject)) (subject.name) }
            p.setting {
                (subject.setting()) ", " (width) "×" (height) " pixels"
                @if !subject.is_whole() { " " (partial_badge(subject)) }
            }
            dl.tiles {
                (tile("PSNR", Some(decimal(mean.psnr, 2)), "dB"))
                (tile("SSIM", Some(decimal(mean.ssim, 4)), ""))
                (tile("LPIPS-VGG", mean.lpips_vgg.map(|v| decimal(v, 4)), ""))
                @if mean.lpips_alex.is_some() {
                    (tile("LPIPS-Alex", mean.lpips_alex.map(|v| decimal(v, 4)), ""))
                }
                (tile("Gaussians", mean.gaussians.map(|n| thousands(n.round() as u64)), ""))
            }
            p.fine {
                @if subject.is_whole() {
                    "Means over all " (count(subject.scored(), "scene")) " that " (evaluation.index) " names."
                } @else {
                    "Means over " (share(subject)) " that " (evaluation.index) " names, so not comparable to means "
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
                    None => (super::numbers::absent()),
                }
            }
        }
    }
}

/// Scenes that couldn't be scored, and why; nothing where all could.
pub fn failures(subjects: &[Subject]) -> Markup {
    let failed: Vec<_> = subjects.iter().filter(|s| !s.evaluation.failures.is_empty()).collect();
    html! {
        @if !failed.is_empty() {
            section.failures id="failures" {
                h2 { "Scenes that failed" }
                @for subject in failed {
                    @let failures = &subject.evaluation.failures;
                    details open[failures.len() <= OPEN_FAILURES] {
                        summary { (subject.name) ", " (subject.setting()) ": " (count(failures.len(), "scene")) }
                        ul {
                            @for failure in failures { li { code { (failure.scene) } " " (failure.error) } }
                        }
                    }
                }
            }
        }
    }
}
