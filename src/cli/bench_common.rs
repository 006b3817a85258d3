//! Code that the subcommands of `bench` share: reading the measured configuration, and printing tables.

use anyhow::Result;
use globalsplat::bench::{Part, Section, TimingStats};
use globalsplat::config::Config;
use std::path::Path;

/// Reads the configuration to measure; without a file, the defaults, which are the paper's main model.
pub fn read_config(file: Option<&Path>, set: &[String]) -> Result<Config> {
    Ok(match file {
        Some(file) => Config::read(file, set)?,
        None => Config::parse("", set, "the defaults".as_ref())?,
    })
}

/// Prints one line per section, with its share of the whole, and one for the whole.
pub fn print_sections(title: &str, sections: &[Section], (name, whole): (&str, &TimingStats)) {
    println!("{title:<18} {:>10} {:>10} {:>10} {:>7}", "median", "min", "p75", "share");
    let row = |name: &str, s: &TimingStats| {
        let share = 1e2 * s.median / whole.median;
        println!("{name:<18} {:>10.1} {:>10.1} {:>10.1} {share:>5.1} %", s.median, s.min, s.upper_quartile);
    };
    sections.iter().for_each(|section| row(&section.name, &section.milliseconds));
    row(name, whole);
}

/// Prints a table of the parts of a forward pass, with their shares of `whole`.
pub fn print_parts(title: &str, parts: &[Part], whole: &TimingStats) {
    println!(
        "{title:<20} {:>9} {:>9} {:>7} {:>9} {:>7} {:>13}",
        "median", "min", "share", "GFLOP", "GB", "of the peak"
    );
    for part in parts {
        let of_peak = match part.gflop > 0. {
            true => format!("{:>11.1} %", 1e2 * part.share_of_peak),
            false => String::new(),
        };
        let rest = format!("{:>9.2} {:>7.3} {of_peak}", part.gflop, part.gigabytes);
        print_part(part.name, &part.milliseconds, whole, &rest);
    }
}

/// Prints the line of one part: its median and minimum time in milliseconds, its share of `whole`, and `rest`.
pub fn print_part(name: &str, s: &TimingStats, whole: &TimingStats, rest: &str) {
    let share = 1e2 * s.median / whole.median;
    println!("{name:<20} {:>9.1} {:>9.1} {share:>5.1} % {rest}", s.median, s.min);
}
