//! Progress events of a session with its scores on a few views, and their log for TensorBoard.

use super::corrections::Corrections;
use crate::data::View;
use crate::error::{Error, Result};
use crate::io::{AppendFile, CONFIG_FILE, EventFile, METRICS_FILE, write_atomically};
use crate::metrics::{CaptureScores, Scores, score_views};
use crate::scene::Gaussians;
use serde::Serialize;
use serde_json::{Value, json};
use std::path::Path;

/// Progress event of a session.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RefineEvent<'a> {
    /// Photos are being read.
    Loading {
        /// Number of photos read so far.
        done: usize,
        /// Number of photos to read, including those of the held-out views.
        count: usize,
    },
    /// Depths are being computed; the value is the number of photos that are done.
    Starting(usize),
    /// A step of the optimization is done.
    Optimizing {
        /// Number of steps done.
        steps: u64,
        /// Most recent PSNR of a sample of the held-out views, in dB.
        psnr: Option<f64>,
    },
    /// Metrics of a step that was just done, every 50 steps.
    Measured(&'a RefineMetrics),
    /// A sample of the held-out views was scored.
    Scored(&'a EvalPoint),
    /// Whole views are being scored; the value is the number of views that are done.
    Scoring(usize),
    /// Warning to print, a sentence: photos that were left out, exposures that are corrected, missing depth information, or too little time.
    /// The callback's answer to it is ignored.
    Warning(&'a str),
}

/// Metrics of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefineMetrics {
    /// Number of steps done.
    pub step: u64,
    /// Time on the session's clock, in seconds.
    pub seconds: f64,
    /// Loss of the step's photos.
    pub loss: f64,
    /// Number of Gaussians.
    pub gaussians: i64,
    /// Learning rate of the means, in units of the scene's depth.
    pub learning_rate: f64,
}

/// Scores of the held-out views at one time during the optimization.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EvalPoint {
    /// Time on the session's clock, in seconds.
    pub seconds: f64,
    /// Number of steps done.
    pub steps: u64,
    /// Mean scores of the sample.
    #[serde(flatten)]
    pub scores: Scores,
}

/// Log in the folder of a run: `metrics.jsonl`, with a line for some of the steps and one for each score, and event files in `tensorboard`.
#[derive(Debug)]
pub struct RefineLog {
    metrics: AppendFile,
    events: EventFile,
}

impl RefineLog {
    /// Creates the log of a refinement that continues after `steps` steps in the folder `run`. The log of an earlier refinement is replaced if
    /// `steps` is 0, and continued otherwise.
    ///
    /// # Errors
    /// Returns an error if the folder has the log of a training, or if a file can't be written.
    pub fn create(run: &Path, steps: u64) -> Result<Self> {
        if run.join(CONFIG_FILE).exists() {
            return Err(Error::input(run, "the log", "a folder of a training run", "another folder"));
        }
        std::fs::create_dir_all(run).map_err(Error::write(run))?;
        let file = run.join(METRICS_FILE);
        if steps == 0 {
            write_atomically(&file, |_| Ok::<_, Error>(()))?;
        }
        let (metrics, mut events) = (AppendFile::open(&file)?, EventFile::create_for(run)?);
        events.start(steps)?;
        Ok(RefineLog { metrics, events })
    }

    /// Writes the metrics of a step.
    ///
    /// # Errors
    /// Returns an error if a file can't be written.
    pub fn log_step(&mut self, metrics: &RefineMetrics) -> Result<()> {
        let RefineMetrics { step, seconds, loss, gaussians, learning_rate } = *metrics;
        let values = [
            ("loss", loss),
            ("gaussians", gaussians as f64),
            ("learning_rate", learning_rate),
            ("seconds", seconds),
        ];
        self.write(step, "refine", &values, |object| object)
    }

    /// Writes scores of the held-out views.
    ///
    /// # Errors
    /// Returns an error if a file can't be written.
    pub fn log_scores(&mut self, point: &EvalPoint) -> Result<()> {
        let values = [("psnr", point.scores.psnr), ("ssim", point.scores.ssim)];
        self.write(point.steps, "validation", &values, |object| json!({ "validation": object }))
    }

    /// Writes `values` after `steps` steps to both files. `line_of` returns the line of the metrics from the object of the values. As in a log
    /// of training, the step is the index of the last one.
    fn write(
        &mut self,
        steps: u64,
        group: &str,
        values: &[(&str, f64)],
        line_of: impl Fn(Value) -> Value,
    ) -> Result<()> {
        let step = steps.saturating_sub(1);
        let object: serde_json::Map<String, Value> =
            values.iter().map(|&(name, value)| (name.to_string(), value.into())).collect();
        let mut line = line_of(object.into());
        line["step"] = step.into();
        self.metrics.append(format!("{line}\n").as_bytes())?;
        let tagged: Vec<_> = values.iter().map(|&(name, value)| (format!("{group}/{name}"), value)).collect();
        self.events.write_scalars(step, &tagged)
    }
}

/// Maximum number of views in a sample.
const MAX_VIEWS: usize = 8;
/// Minimum number of views in a small sample, if there are as many.
const MIN_VIEWS: usize = 2;
/// Maximum number of pixels of all views in a small sample, if there are more than [`MIN_VIEWS`].
const MAX_PIXELS: u64 = 1_200_000;

/// Evenly spread views of all. They are scored as a whole: a part of an image has other borders, near which large Gaussians are projected
/// differently.
#[derive(Debug)]
pub(super) struct ViewSample {
    /// Indices among all views.
    indices: Vec<usize>,
    views: Vec<View>,
}

impl ViewSample {
    /// Chooses up to eight of `views`, fewer if they are large, to be scored several times.
    pub fn small(views: &[View]) -> Self {
        let pixels = |view: &View| u64::from(view.camera.width) * u64::from(view.camera.height);
        let largest = views.iter().map(pixels).max().unwrap_or(1);
        ViewSample::spread(views, ((MAX_PIXELS / largest) as usize).clamp(MIN_VIEWS, MAX_VIEWS))
    }

    /// Chooses up to eight of `views`.
    pub fn large(views: &[View]) -> Self {
        ViewSample::spread(views, MAX_VIEWS)
    }

    fn spread(views: &[View], count: usize) -> Self {
        let every = views.len().div_ceil(count).max(1);
        let indices: Vec<usize> = (0..views.len()).step_by(every).collect();
        let views = indices.iter().map(|&index| views[index].shallow_clone());
        ViewSample { views: views.collect(), indices }
    }

    /// Returns the number of views.
    pub fn len(&self) -> usize {
        self.views.len()
    }

    /// Returns the sample with the learned corrections of its photos applied.
    pub(super) fn corrected(&self, corrections: &Corrections) -> Self {
        let views = self.indices.iter().zip(&self.views).map(|(&index, view)| corrections.apply(index, view));
        ViewSample { indices: self.indices.clone(), views: views.collect() }
    }

    /// Scores a splat; returns `None` if there are no views.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn score(&self, gaussians: &Gaussians) -> Result<Option<Scores>> {
        Ok(score_views("sample", gaussians, &self.views, None, |_| true)?.map(|scores| scores.mean))
    }

    /// Returns the mean scores of the sample, given the `scores` of all views that it was chosen from.
    pub fn select_scores(&self, scores: &CaptureScores) -> Scores {
        Scores::mean(self.indices.iter().map(|&index| &scores.views[index].scores))
    }
}

/// Returns the first few names, and the number of the others.
pub(super) fn summarize_names(all: &[String]) -> String {
    const FEW: usize = 3;
    let few = all[..all.len().min(FEW)].join(", ");
    if all.len() > FEW { format!("{few} and {} more", all.len() - FEW) } else { few }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::render_views;
    use crate::scene::{Camera, Intrinsics};
    use glam::DMat4;
    use tch::{Device, Kind, Tensor};

    #[test]
    fn a_sample_has_few_pixels_and_its_scores_are_those_of_the_views() {
        let gaussians = Gaussians {
            means: Tensor::from_slice(&[0f32, 0., 3.]).view([1, 1, 3]),
            scales: Tensor::full([1, 1, 3], 0.5, (Kind::Float, Device::Cpu)),
            quaternions: Tensor::from_slice(&[1f32, 0., 0., 0.]).view([1, 1, 4]),
            opacities: Tensor::full([1, 1], 0.7, (Kind::Float, Device::Cpu)),
            sh: Tensor::ones([1, 1, 1, 3], (Kind::Float, Device::Cpu)),
            antialiased: false,
        };
        let views = |width: u32, height: u32, count: usize| -> Vec<View> {
            let intrinsics = Intrinsics { fx: 200., fy: 190., cx: 100., cy: 80. };
            let camera = Camera { intrinsics, c2w: DMat4::IDENTITY, width, height };
            let image = render_views(&gaussians, &[camera]).unwrap().remove(0).rgb;
            let view = |index: usize| {
                let image = (&image + 0.01 + 0.001 * index as f64).into();
                View { name: String::new(), image, mask: None, camera }
            };
            (0..count).map(view).collect()
        };
        let all = views(210, 170, 20);
        let small = ViewSample::small(&all);
        assert_eq!(small.indices, [0, 3, 6, 9, 12, 15, 18]);
        let large = views(1000, 600, 9);
        assert_eq!(ViewSample::small(&large).indices, [0, 5]);
        assert_eq!(ViewSample::large(&large).indices, [0, 2, 4, 6, 8]);
        let scores = small.score(&gaussians).unwrap().unwrap();
        let of_all = score_views("", &gaussians, &all, None, |_| true).unwrap().unwrap();
        let first = &of_all.views[0].scores;
        assert!((first.psnr - 40.).abs() < 0.01 && first.ssim > 0.9, "{of_all:?}");
        let selected = small.select_scores(&of_all);
        assert!((scores.psnr - selected.psnr).abs() < 1e-9 && (scores.ssim - selected.ssim).abs() < 1e-9);
        assert!((scores.psnr - of_all.mean.psnr).abs() > 0.01, "{scores:?} {}", of_all.mean.psnr);
        assert!(ViewSample::small(&[]).score(&gaussians).unwrap().is_none());
    }
}
