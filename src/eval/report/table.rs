//! Building blocks of tables.

use super::entry::Entry;
use super::numbers::absent;
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
        @if [height, width] != super::super::published::IMAGE_SIZE {
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
    let of = super::numbers::count(entry.evaluation.indexed_scenes, "scene");
    format!("{} of {of}", super::numbers::thousands(entry.scored() as u64))
}

/// Renders a swatch of the colour that plots use for the entry.
pub fn swatch(entry: &Entry) -> Markup {
    html! { span.swatch.(entry.colour) aria-hidden="true" {} }
}
