//! Progress on standard error: a progress bar on a terminal, otherwise a line every half minute.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::{IsTerminal, stderr};
use std::ops::Deref;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;

/// Interval between lines.
const PAUSE: Duration = Duration::from_secs(30);

/// Progress bar, with a thread that writes lines if standard error is not a terminal.
pub struct Progress {
    bar: ProgressBar,
    /// Channel whose drop ends the thread.
    _lines: Option<Sender<()>>,
}

/// Unit of a bar's position.
#[derive(Clone, Copy)]
enum Unit {
    /// Items with this name, at a measured rate.
    Items(&'static str),
    /// Seconds of a fixed time budget, so the time left is exact.
    Seconds,
}

/// Creates a progress bar over `length` items, with rate and time left.
pub fn bar(length: u64, unit: &'static str) -> Progress {
    let template = format!("{{bar:30}} {{pos}}/{{len}} {unit} {{per_sec}} {{elapsed}} <{{eta}} {{msg}}");
    progress(length, &template, Unit::Items(unit))
}

/// Creates a progress bar over a time budget: its position is the number of seconds elapsed.
pub fn time_bar(time: Duration) -> Progress {
    progress(time.as_secs_f64().ceil() as u64, "{bar:30} {pos}/{len} s {msg}", Unit::Seconds)
}

fn progress(length: u64, template: &str, unit: Unit) -> Progress {
    let style =
        ProgressStyle::with_template(template).expect("a template that is right").progress_chars("━╸─");
    let bar = ProgressBar::new(length).with_style(style);
    let lines = (!stderr().is_terminal()).then(|| write_lines(bar.clone(), unit));
    Progress { bar, _lines: lines }
}

/// Creates a [`bar`] in the first of the processes that share the work, and a hidden one in the others.
pub fn bar_on_first_rank(is_main_process: bool, length: u64, unit: &'static str) -> Progress {
    match is_main_process {
        true => bar(length, unit),
        false => Progress { bar: ProgressBar::hidden(), _lines: None },
    }
}

impl Deref for Progress {
    type Target = ProgressBar;

    fn deref(&self) -> &ProgressBar {
        &self.bar
    }
}

fn write_lines(bar: ProgressBar, unit: Unit) -> Sender<()> {
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
fn line(bar: &ProgressBar, unit: Unit) -> String {
    let (done, of) = (bar.position(), bar.length().unwrap_or(0));
    let mut line = match unit {
        Unit::Items(unit) if done > 0 => format!("{done} of {of} {unit}{}", rate(bar.per_sec(), bar.eta())),
        Unit::Items(unit) => format!("{done} of {of} {unit}"),
        Unit::Seconds => {
            let left = duration(Duration::from_secs(of.saturating_sub(done)));
            format!("{done} of {of} seconds, {left} left")
        }
    };
    if !bar.message().is_empty() {
        line += &format!(", {}", bar.message());
    }
    line
}

/// Formats the rate and the time left; there is no estimate if the work has stalled.
fn rate(per_second: f64, left: Duration) -> String {
    const FOR_EVER: Duration = Duration::from_secs(365 * 24 * 3600);
    if left > FOR_EVER {
        return ", none for a while".into();
    }
    format!(", {per_second:.1} a second, {} left", duration(left))
}

/// Formats a duration in words, rounded to seconds, minutes or hours.
fn duration(time: Duration) -> String {
    let (minutes, hours) = (time.as_secs().div_ceil(60), time.as_secs() / 3600);
    match time.as_secs() {
        ..90 => format!("{} seconds", time.as_secs()),
        90..7200 => format!("{minutes} minutes"),
        _ => format!("{hours} hours"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_tell_where_the_work_stands() {
        let bar = ProgressBar::hidden();
        bar.set_length(10);
        assert_eq!(line(&bar, Unit::Items("scenes")), "0 of 10 scenes");
        bar.set_position(4);
        bar.set_message("loss 0.5");
        let line = line(&bar, Unit::Items("scenes"));
        assert!(line.starts_with("4 of 10 scenes, ") && line.ends_with(" left, loss 0.5"), "{line}");
    }

    /// The time left of a fixed budget is independent of the rate of the work.
    #[test]
    fn a_time_budget_shows_the_exact_time_left() {
        let bar = ProgressBar::hidden();
        bar.set_length(60);
        assert_eq!(line(&bar, Unit::Seconds), "0 of 60 seconds, 60 seconds left");
        bar.set_position(52);
        bar.set_message("900 steps");
        assert_eq!(line(&bar, Unit::Seconds), "52 of 60 seconds, 8 seconds left, 900 steps");
        bar.set_position(61);
        assert_eq!(line(&bar, Unit::Seconds), "61 of 60 seconds, 0 seconds left, 900 steps");
    }

    #[test]
    fn stalled_work_has_no_estimate() {
        assert_eq!(rate(2., Duration::from_secs(5)), ", 2.0 a second, 5 seconds left");
        assert_eq!(rate(1e-9, Duration::from_secs(1 << 40)), ", none for a while");
    }

    #[test]
    fn durations_are_in_words() {
        let of = |seconds| duration(Duration::from_secs(seconds));
        assert_eq!((of(5), of(89), of(100)), ("5 seconds".into(), "89 seconds".into(), "2 minutes".into()));
        assert_eq!(
            (of(7199), of(7200), of(90_000)),
            ("120 minutes".into(), "2 hours".into(), "25 hours".into())
        );
    }
}
