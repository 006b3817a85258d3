//! Rows of a comparison: measured and published scores of one dataset and number of context views.

use super::entry::Entry;
use super::numbers;
use crate::eval::published::published;
use std::collections::BTreeSet;

/// A row of a comparison.
pub struct Row<'a> {
    pub name: &'a str,
    /// Evaluation that was measured; `None` for a published row.
    pub measured: Option<&'a Entry<'a>>,
    pub psnr: Option<f64>,
    pub ssim: Option<f64>,
    pub lpips: Option<f64>,
    pub kilo_gaussians: Option<f64>,
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
    let theirs = methods.filter_map(|method| {
        let scores = method.scores.get(&views)?;
        Some(Row {
            name: &method.method,
            measured: None,
            psnr: scores.psnr,
            ssim: scores.ssim,
            lpips: scores.lpips,
            kilo_gaussians: scores.kilo_gaussians,
        })
    });
    let measured = entries.iter().filter(|s| s.dataset == dataset && s.evaluation.context_views == views);
    let ours = measured.map(|entry| {
        let mean = entry.evaluation.summary.mean;
        Row {
            name: &entry.name,
            measured: Some(entry),
            psnr: numbers::mean(mean.psnr),
            ssim: numbers::mean(mean.ssim),
            lpips: mean.lpips_vgg.and_then(numbers::mean),
            kilo_gaussians: entry.evaluation.summary.gaussians.and_then(numbers::mean).map(|n| n * 1e-3),
        }
    });
    let mut rows: Vec<Row> = theirs.chain(ours).collect();
    let order = |row: &Row| row.psnr.unwrap_or(f64::NEG_INFINITY);
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
