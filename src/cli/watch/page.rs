//! The page: HTML that its script fills with the state of the run.

use maud::{DOCTYPE, Markup, PreEscaped, html};

/// Style sheet of the reports, so that both look alike.
const REPORT_STYLE: &str = include_str!("../../eval/report/style.css");
const STYLE: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("page.js");

/// Page with its content security policy.
pub struct Page {
    pub html: String,
    pub policy: String,
}

impl Page {
    /// Creates a page with a random nonce, by which the browser distinguishes our script and style from any that a name
    /// injects.
    pub fn new() -> Self {
        let nonce = format!("{:032x}", rand::random::<u128>());
        let policy = format!(
            "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src 'self' data:; \
             connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        );
        Page { html: page(&nonce).into_string(), policy }
    }
}

fn page(nonce: &str) -> Markup {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                // Without this, browsers request a favicon from the server.
                link rel="icon" href="data:,";
                title { "A run" }
                style nonce=(nonce) { (PreEscaped(REPORT_STYLE)) (PreEscaped(STYLE)) }
            }
            body {
                main {
                    header {
                        p.kicker { "Training run" }
                        h1 #name { "…" }
                        div.progress {
                            progress #progress max="1" value="0" aria-label="Steps done" {}
                            p.fine #progress-words {}
                        }
                    }
                    noscript { p { "This page needs JavaScript; it loads none from elsewhere." } }
                    section.failures #notices aria-label="Notices" aria-live="polite" hidden { ul {} }
                    section.card.now aria-label="Now" { dl.tiles #tiles {} }
                    section aria-label="Curves" { div.plots #plots {} }
                    section #pictures hidden {
                        h2 { "Images" }
                        p { "Of a scene in training: a photo that the model sees, a target, what it makes of that, its depth and \
                             its opacity." }
                        div.shown {}
                    }
                    section #checkpoints hidden {
                        h2 { "Checkpoints" }
                        div.scroll {
                            table {
                                thead { tr {
                                    th scope="col" { "Folder" }
                                    @for name in ["Step", "Size", "Age", "Held out"] { th.number scope="col" { (name) } }
                                } }
                                tbody {}
                            }
                        }
                    }
                    footer { p #footer {} }
                }
                script nonce=(nonce) { (PreEscaped(SCRIPT)) }
            }
        }
    }
}
