//! Parts that tables share.

use super::entry::Entry;
use super::numbers::absent;
use maud::{Markup, html};

/// What heads a column, which is aligned as its cells are.
pub enum Head {
    Text(&'static str),
    Number(&'static str),
}

/// A table that scrolls by itself where it is wider than the screen.
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

/// A cell with a number, or the word for none.
pub fn cell(value: Option<String>) -> Markup {
    html! { td.number { @match value { Some(text) => (text), None => (absent()) } } }
}

/// Marks a row that the paper has.
pub fn published_badge() -> Markup {
    html! { span.badge.published { "published" } }
}

/// Marks a row that was measured, with what keeps its numbers from being compared to published ones.
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

/// How many scenes a mean is of, where it isn't of all.
pub fn partial_badge(entry: &Entry) -> Markup {
    html! { span.badge.partial { (share(entry)) } }
}

/// `2 of 5,601 scenes`.
pub fn share(entry: &Entry) -> String {
    let of = super::numbers::count(entry.evaluation.indexed_scenes, "scene");
    format!("{} of {of}", super::numbers::thousands(entry.scored() as u64))
}

/// A name with the colour that plots show it in.
pub fn swatch(entry: &Entry) -> Markup {
    html! { span.swatch.(entry.colour) aria-hidden="true" {} }
}
