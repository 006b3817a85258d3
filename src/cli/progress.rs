//! Progress on standard error: a progress bar on a terminal, otherwise a line every half minute.

use super::distributed;
use indicatif::{HumanDuration, ProgressBar, ProgressStyle};
use std::io::{IsTerminal, stderr};
use std::ops::Deref;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;

/// Interval between lines.
const PAUSE: Duration = Duration::from_secs(30);
/// Time left that is no estimate any more, because the work has stalled.
const FOR_EVER: Duration = Duration::from_secs(365 * 24 * 3600);
/// Unit of a time budget, of which the time left is known exactly.
const SECONDS: &str = "seconds";

/// Progress bar, with a thread that writes lines if standard error is not a terminal. It is hidden in processes that print nothing.
pub struct Progress {
    bar: ProgressBar,
    /// Channel whose drop ends the thread.
    _lines: Option<Sender<()>>,
}

/// Creates a progress bar over `length` items, with rate and time left.
pub fn bar(length: u64, unit: &'static str) -> Progress {
    let template = format!("{{bar:30}} {{pos}}/{{len}} {unit} {{per_sec}} {{elapsed}} <{{eta}} {{msg}}");
    progress(length, unit, &template)
}

/// Creates a progress bar over a time budget: its position is the number of seconds elapsed.
pub fn time_bar(time: Duration) -> Progress {
    progress(time.as_secs_f64().ceil() as u64, SECONDS, "{bar:30} {pos}/{len} s {msg}")
}

fn progress(length: u64, unit: &'static str, template: &str) -> Progress {
    if !distributed::is_main_process() {
        return Progress { bar: ProgressBar::hidden(), _lines: None };
    }
    let style =
        ProgressStyle::with_template(template).expect("a template that is right").progress_chars("━╸─");
    let bar = ProgressBar::new(length).with_style(style);
    let lines = (!stderr().is_terminal()).then(|| write_lines(bar.clone(), unit));
    Progress { bar, _lines: lines }
}

impl Deref for Progress {
    type Target = ProgressBar;

    fn deref(&self) -> &ProgressBar {
        &self.bar
    }
}

fn write_lines(bar: ProgressBar, unit: &'static str) -> Sender<()> {
    let (sender, receiver) = channel();
    std::thread::spawn(move || {
        while receiver.recv_timeout(PAUSE) == Err(RecvTimeoutError::Timeout) && !bar.is_finished() {
            eprintln!("globalsplat: {}", line(&bar, unit));
        }
    });
    sender
}

/// Formats the progress, as `600 of 3000 steps, 8.1 a second, 5 minutes left, loss 0.02` or `20 of 60 seconds, 40 seconds
/// left`.
fn line(bar: &ProgressBar, unit: &str) -> String {
    let (done, of) = (bar.position(), bar.length().unwrap_or(0));
    let mut parts = vec![format!("{done} of {of} {unit}")];
    let left = match unit {
        SECONDS => Some(Duration::from_secs(of.saturating_sub(done))),
        _ => Some(bar.eta()).filter(|left| done > 0 && *left < FOR_EVER),
    };
    if let Some(left) = left {
        if unit != SECONDS {
            parts.push(format!("{:.1} a second", bar.per_sec()));
        }
        parts.push(format!("{} left", HumanDuration(left)));
    }
    parts.extend(Some(bar.message()).filter(|message| !message.is_empty()));
    parts.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_tell_where_the_work_stands() {
        let bar = ProgressBar::hidden();
        bar.set_length(60);
        assert_eq!(line(&bar, "scenes"), "0 of 60 scenes");
        // The time left of a budget is independent of the rate of the work.
        assert_eq!(line(&bar, SECONDS), "0 of 60 seconds, 60 seconds left");
        bar.set_position(52);
        bar.set_message("900 steps");
        assert_eq!(line(&bar, SECONDS), "52 of 60 seconds, 8 seconds left, 900 steps");
        let items = line(&bar, "scenes");
        assert!(items.starts_with("52 of 60 scenes, ") && items.ends_with(" left, 900 steps"), "{items}");
    }
}
