//! One page that shows evaluations beside what the paper published: a file that needs no other, nor a network.

mod comparison;
mod cost;
mod entry;
mod heading;
mod numbers;
mod plot;
mod rows;
mod scenes;
mod table;

pub use plot::write_curves;

use super::evaluation::Evaluation;
use crate::error::{Error, Result};
use crate::io::write_atomically;
use entry::Entry;
use maud::{DOCTYPE, Markup, PreEscaped, html};
use std::path::{Path, PathBuf};

const STYLE: &str = include_str!("style.css");
/// Sorts tables by a click on a heading; the page is whole without it.
const SORTING: &str = include_str!("sorting.js");

/// Writes the page that shows `evaluations` at `path`. Each comes with the folder it was written to, which holds the
/// pictures of its scenes.
///
/// # Errors
/// No evaluation, a picture that is there but can't be read, or the system's refusal to write.
pub fn write_report(path: &Path, evaluations: &[(PathBuf, Evaluation)]) -> Result<()> {
    if evaluations.is_empty() {
        return Err(Error::Request("a report shows one evaluation or more, found none".into()));
    }
    let page = page(&entry::entries(evaluations))?.into_string();
    write_atomically(path, |writer| writer.write_all(page.as_bytes()).map_err(Error::write(path)))
}

fn page(entries: &[Entry]) -> Result<Markup> {
    let title = heading::title(entries);
    Ok(html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                // Without it a browser asks the server for an icon.
                link rel="icon" href="data:,";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                main {
                    (heading::heading(&title, entries))
                    (heading::failures(entries))
                    (comparison::comparisons(entries))
                    (cost::efficiency(entries))
                    div.halves { (cost::compactness()) (cost::ablations()) }
                    (scenes::scenes(entries)?)
                    footer {
                        p { "Published rows are those of the GlobalSplat paper (Itkin et al.), as printed there. Its "
                            "numbers for NoPoSplat and AnySplat were first published by C3G, those for EcoSplat by "
                            "EcoSplat's authors." }
                        p { "Written by globalsplat " (env!("CARGO_PKG_VERSION")) "." }
                    }
                }
                script { (PreEscaped(SORTING)) }
            }
        }
    })
}
