//! Evaluations and published results as the page shows them: names, colors, rows of a comparison, and formatted numbers.

use crate::eval::evaluation::{Evaluation, Summary};
use crate::eval::published::{DATASETS, PublishedScores, known_dataset, published};
use maud::{Markup, html};
use plotters::style::{Color, Palette, Palette99, RGBColor};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Position in the palette of the first published method. Those before it are for measured ones.
const FIRST_PUBLISHED_COLOR: usize = 20;

fn color(position: usize) -> RGBColor {
    let (red, green, blue) = Palette99::pick(position).to_backend_color().rgb;
    RGBColor(red, green, blue)
}

/// One evaluation on the page.
pub struct Entry<'a> {
    pub folder: &'a Path,
    pub evaluation: &'a Evaluation,
    /// Name of the method, followed by the folder if several evaluations would have the same name.
    pub name: String,
    /// Key of the dataset: `re10k`, `acid`, `dl3dv`, or the name in the evaluation if it isn't a known one.
    pub dataset: String,
    /// Color. It depends on the name alone, so that a method has the same color for all datasets and view counts.
    pub color: RGBColor,
}

/// Creates the entries of `evaluations`, in the same order.
pub fn entries(evaluations: &[(PathBuf, Evaluation)]) -> Vec<Entry<'_>> {
    let mut names: Vec<String> = vec![];
    let mut entries = vec![];
    for (folder, evaluation) in evaluations {
        let same = |other: &Evaluation| {
            (&other.method, dataset_key(&other.dataset), other.context_views)
                == (&evaluation.method, dataset_key(&evaluation.dataset), evaluation.context_views)
        };
        let alone = evaluations.iter().filter(|(_, other)| same(other)).count() == 1;
        let name = match alone {
            true => evaluation.method.clone(),
            false => format!("{} ({})", evaluation.method, folder.display()),
        };
        let position = names.iter().position(|n| *n == name).unwrap_or_else(|| {
            names.push(name.clone());
            names.len() - 1
        });
        entries.push(Entry {
            folder,
            evaluation,
            name,
            dataset: dataset_key(&evaluation.dataset),
            color: color(position),
        });
    }
    entries
}

fn dataset_key(name: &str) -> String {
    known_dataset(name).map_or(name.into(), String::from)
}

/// Returns the name of a dataset for readers.
pub fn dataset_name(key: &str) -> &str {
    DATASETS.iter().find(|(file, _)| *file == key).map_or(key, |(_, people)| people)
}

impl Entry<'_> {
    /// Returns the number of scenes that were scored.
    pub fn scored(&self) -> usize {
        self.evaluation.scenes.len()
    }

    /// Returns `true` if the means are over all scenes that the index names.
    pub fn is_whole(&self) -> bool {
        self.scored() >= self.evaluation.indexed_scenes
    }

    /// Returns the dataset and the number of context views, as text.
    pub fn setting(&self) -> String {
        format!("{}, {} context views", dataset_name(&self.dataset), self.evaluation.context_views)
    }
}

/// A row of a comparison.
pub struct Row<'a> {
    pub name: &'a str,
    /// Evaluation that was measured; `None` for a published row.
    pub measured: Option<&'a Entry<'a>>,
    pub scores: PublishedScores,
    pub color: RGBColor,
}

impl Row<'_> {
    /// Returns `true` if this is the published row of the paper's own method.
    pub fn is_published_globalsplat(&self) -> bool {
        self.measured.is_none() && self.name.starts_with("GlobalSplat")
    }
}

/// Returns all measured and published rows of one dataset and number of context views, best PSNR first.
pub fn rows<'a>(entries: &'a [Entry<'a>], dataset: &str, views: usize) -> Vec<Row<'a>> {
    let methods = published().novel_views.iter().filter(|method| method.dataset == dataset);
    let theirs = methods.enumerate().filter_map(|(position, method)| {
        let (name, scores) = (&method.method, *method.scores.get(&views)?);
        Some(Row { name, measured: None, scores, color: color(FIRST_PUBLISHED_COLOR + position) })
    });
    let measured = entries.iter().filter(|s| s.dataset == dataset && s.evaluation.context_views == views);
    let ours = measured.map(|entry| {
        let Summary { mean, gaussians } = entry.evaluation.summary;
        let scores = PublishedScores {
            psnr: finite(mean.psnr),
            ssim: finite(mean.ssim),
            lpips: mean.lpips_vgg.and_then(finite),
            kilo_gaussians: gaussians.and_then(finite).map(|n| n * 1e-3),
        };
        Row { name: &entry.name, measured: Some(entry), scores, color: entry.color }
    });
    let mut rows: Vec<Row> = theirs.chain(ours).collect();
    let order = |row: &Row| row.scores.psnr.unwrap_or(f64::NEG_INFINITY);
    rows.sort_by(|a, b| order(b).total_cmp(&order(a)));
    rows
}

/// Returns the numbers of context views with published or measured scores.
pub fn view_counts(entries: &[Entry], dataset: &str) -> BTreeSet<usize> {
    let methods = published().novel_views.iter().filter(|method| method.dataset == dataset);
    let theirs = methods.flat_map(|method| method.scores.keys().copied());
    let ours = entries.iter().filter(|s| s.dataset == dataset).map(|s| s.evaluation.context_views);
    theirs.chain(ours).collect()
}

/// Formats an integer with thousands separators: `5601` as `5,601`.
pub fn thousands(value: u64) -> String {
    let digits = value.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// Formats a number with `digits` decimal places and thousands separators.
pub fn decimal(value: f64, digits: usize) -> String {
    let text = format!("{:.digits$}", value.abs());
    let (whole, rest) = text.split_at(text.find('.').unwrap_or(text.len()));
    let sign = if value < 0. && text.contains(|c: char| ('1'..='9').contains(&c)) { "−" } else { "" };
    format!("{sign}{}{rest}", whole.parse().map_or(whole.to_string(), thousands))
}

/// Formats a number with one decimal place, or with none if it is a whole number or at least 100: `16.4`, `393`, `0.1`.
pub fn short(value: f64) -> String {
    decimal(value, if value.fract() == 0. || value.abs() >= 100. { 0 } else { 1 })
}

/// Returns `value` if it is finite. The mean over no scenes is not a number.
pub fn finite(value: f64) -> Option<f64> {
    Some(value).filter(|value| value.is_finite())
}

/// Formats a count with its noun, such as `1 scene` or `5,601 scenes`.
pub fn count(number: usize, one: &str) -> String {
    format!("{} {one}{}", thousands(number as u64), if number == 1 { "" } else { "s" })
}

/// Renders the word for a value that was not measured or not published. An empty cell or a zero could be mistaken for a result.
pub fn absent() -> Markup {
    html! { span.absent { "absent" } }
}

/// Renders a swatch of the color that plots use for a method.
pub fn swatch(RGBColor(red, green, blue): RGBColor) -> Markup {
    html! { span.swatch style={ "background: rgb(" (red) " " (green) " " (blue) ")" } aria-hidden="true" {} }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_formatted() {
        assert_eq!(thousands(5601), "5,601");
        assert_eq!(thousands(123), "123");
        assert_eq!(thousands(4_064_762), "4,064,762");
        assert_eq!(decimal(1234.567, 2), "1,234.57");
        assert_eq!(decimal(-0.5, 1), "−0.5");
        assert_eq!(decimal(-0.001, 2), "0.00");
        assert_eq!(
            (short(16.384), short(393.), short(0.1), short(2359.4)),
            ("16.4".into(), "393".into(), "0.1".into(), "2,359".into())
        );
        assert_eq!((count(1, "scene"), count(5601, "scene")), ("1 scene".into(), "5,601 scenes".into()));
    }
}
