//! Progress bars on standard error, quiet where that is no terminal.

use indicatif::{ProgressBar, ProgressStyle};

/// A bar of `length` items with rate and time left.
pub fn bar(length: u64, unit: &str) -> ProgressBar {
    let template = format!("{{bar:30}} {{pos}}/{{len}} {unit} {{per_sec}} {{elapsed}} <{{eta}} {{msg}}");
    let style =
        ProgressStyle::with_template(&template).expect("a template that is right").progress_chars("━╸─");
    ProgressBar::new(length).with_style(style)
}
