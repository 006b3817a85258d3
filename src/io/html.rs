//! HTML pages that need no other files and no network access.

use maud::{DOCTYPE, Markup, PreEscaped, html};

/// Returns a page in English for light and dark color schemes, with the CSS `style` in it.
pub fn html_page(title: &str, style: &str, body: &Markup) -> Markup {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                // Without this link a browser asks the server for an icon.
                link rel="icon" href="data:,";
                title { (title) }
                style { (PreEscaped(style)) }
            }
            body { (body) }
        }
    }
}
