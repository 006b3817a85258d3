//! Report: a self-contained HTML page that shows evaluations next to the paper's published results, without other files or network access.

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
/// Script that sorts a table when a heading is clicked. The page is complete without it.
const SORTING: &str = include_str!("sorting.js");

/// Writes the page that shows `evaluations` to `path`. Each evaluation comes with the folder that it was written to, which holds the
/// comparison images of its scenes.
///
/// # Errors
/// Fails if there is no evaluation, if an existing image can't be read, or if the file can't be written.
pub fn write_report(path: &Path, evaluations: &[(PathBuf, Evaluation)]) -> Result<()> {
    if evaluations.is_empty() {
        return Err(Error::request("a report shows one evaluation or more, found none"));
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
                // Without this link a browser asks the server for an icon.
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
