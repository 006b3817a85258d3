//! The command `refine`, which also does the work of `reconstruct --refine`.

use super::capture::{SceneSource, UprightOption};
use super::progress::{self, Progress};
use super::splat_out::{self, LocalOrigin};
use super::{
    Output, check_views, device, keep_freed_memory, model, open_masked_capture, report_downscaling, signals,
    warn,
};
use crate::data::{Capture, PhotoSize};
use crate::device::process_age;
use crate::error::Error;
use crate::io::{
    InputFiles, ShLimits, Splat, WriteOptions, check_writable_dir, check_writable_file, check_writable_png,
    check_writable_splat, checksum, fit_splat, parent_of, read_splat, splat_files, write_local_splat,
};
use crate::metrics::{CaptureScores, Scores};
use crate::model::Precision;
use crate::quality::Verdict;
use crate::reconstruct::spread_over_path;
use crate::refine::{
    Budget, Correction, EvalPoint, RefineEvent, RefineLog, RefineOptions, RefineResult, RefineSession,
    RefineState, SceneInit,
};
use crate::scene::{Camera, LocalFrame};
use anyhow::Result;
use clap::Args;
use glam::DVec3;
use serde_json::json;
use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Maximum number of cameras for which a splat's colors are fitted to the range of its file format.
const FITTED_CAMERAS: usize = 64;

/// Estimated time for writing the state of an optimization, per Gaussian.
const STATE_TIME_PER_GAUSSIAN: Duration = Duration::from_micros(1);

/// Optimize a splat on the photos of its scene, or create one from the photos alone.
///
/// The Gaussians are optimized until their renders match the photos. Without --splat they are initialized where the depths of
/// several photos agree, and their number grows to --gaussians; neither weights nor a GPU are needed. Ctrl-C ends the
/// optimization early and writes the current splat.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat refine --scene captures/room --out room.ply\n  \
    globalsplat refine --photos photos/room --out room.ply\n  \
    globalsplat refine --splat room.ply --scene captures/room --out better.ply --seconds 30\n  \
    globalsplat refine --scene captures/room --holdout every:8 --contact-sheet views.png --out room.ply\n  \
    globalsplat refine --scene captures/room --gaussians 100000 --seconds 240 --out room.ply")]
pub struct Refine {
    /// Initial splat, in the capture's world coordinates, in any format that `convert` reads
    #[arg(long, value_name = "FILE", conflicts_with = "gaussians")]
    pub splat: Option<PathBuf>,
    /// Initialization without --splat: from the photos alone, or from a model's reconstruction, with new Gaussians up to --gaussians
    #[arg(long, value_parser = ["photos", "model"], conflicts_with = "splat")]
    pub init: Option<String>,
    /// Weights of the initial model, as `globalsplat export` writes them; by default the weights embedded in this program
    #[arg(long, value_name = "FILE", conflicts_with = "splat")]
    pub weights: Option<PathBuf>,
    #[command(flatten)]
    pub scene: SceneSource,
    #[command(flatten)]
    pub upright: UprightOption,
    /// Folder of masks named like the photos, as in photo.jpg.png or photo.png: black pixels are ignored; by default the masks and
    /// transparency of the capture itself
    #[arg(long, value_name = "DIR")]
    pub masks: Option<PathBuf>,
    /// Output splat: .ply, .compressed.ply, .sog, meta.json, .spz, .splat, .glb or .gltf
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Write the state of the optimization beside the splat, as in room.state.safetensors, and continue from it if it is there:
    /// --seconds and --steps include those of the earlier runs
    #[arg(long)]
    pub resume: bool,
    /// Go on with a capture whose verdict is that it will fail
    #[arg(long)]
    pub ignore_verdict: bool,
    #[command(flatten)]
    pub local_origin: LocalOrigin,
    #[command(flatten)]
    pub options: RefineOptions,
    #[command(flatten)]
    pub reports: Reports,
    /// Device of the optimization: cpu, cuda or cuda:N
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    pub device: String,
}

/// What a refinement reports besides its result.
#[derive(Default, Args)]
pub struct Reports {
    /// Also write curves of the loss and the scores to a folder: metrics.jsonl and tensorboard, which TensorBoard
    /// shows during the optimization
    #[arg(long, value_name = "DIR")]
    log: Option<PathBuf>,
    /// Also write an image: photo, render and depth side by side, a row per held-out view, or else per view
    #[arg(long, value_name = "FILE.png")]
    contact_sheet: Option<PathBuf>,
    /// Also score by LPIPS, before and after, if its weights are found; this takes additional time, after the splat is written
    #[arg(long)]
    lpips: bool,
}

impl Refine {
    pub fn run(mut self) -> Result<Output> {
        check_views(self.options.max_views)?;
        self.options.device = device::parse(&self.device)?;
        self.options.resolve(self.splat.is_some())?;
        if self.init.as_deref() == Some("photos") && self.weights.is_some() {
            return Err(Error::request("--init photos uses no weights; --init model does").into());
        }
        let started = Instant::now().checked_sub(process_age().unwrap_or_default());
        check_writable_splat(&self.out)?;
        self.local_origin.check(&self.out, self.splat.as_deref())?;
        self.reports.contact_sheet.iter().try_for_each(|sheet| check_writable_png(sheet))?;
        let state_file = RefineState::path_for(&self.out);
        if self.resume {
            check_writable_file(&state_file)?;
        }
        self.reports
            .log
            .iter()
            .try_for_each(|log| check_writable_dir(log).and_then(|()| RefineLog::check(log).map(drop)))?;
        signals::handle_stop_requests();
        signals::end_at_request(1);
        let (path, masks) = self.scene.path(self.masks.as_deref(), self.upright, &self.out)?;
        // The time budget begins after the poses of photos are found.
        let clock = started.filter(|_| !self.scene.is_unposed()).unwrap_or_else(Instant::now);
        self.options.started = Some(clock);
        let capture = open_masked_capture(&path, masks)?;
        let transform = capture.upright();
        self.check_outputs(&capture, &state_file)?;
        let splat = self.splat.as_deref().map(read_splat).transpose()?;
        warn(splat.as_ref().map_or(&[], |splat| &splat.warnings));
        let source = self.source()?;
        let (mut loaded, mut state) = (None, None);
        let init = match &splat {
            _ if self.resume && state_file.exists() => {
                let state = state.insert(RefineState::read(&state_file)?);
                state.check_source(&source)?;
                eprintln!("{}: continues after {} steps", state_file.display(), state.steps());
                SceneInit::State(state)
            }
            Some(splat) => SceneInit::Splat(splat),
            None if self.is_from_model() => {
                let load = model::load(self.weights.as_deref(), Some(Precision::F32), self.options.device);
                SceneInit::Model(loaded.insert(load?))
            }
            None => SceneInit::Photos,
        };
        let bar = Bar::new(self.options.budget(), clock);
        let steps = if let SceneInit::State(state) = init { state.steps() } else { 0 };
        let log = RefCell::new(None::<RefineLog>);
        let on_event = |event: RefineEvent| {
            bar.update(event);
            let mut log = log.borrow_mut();
            if let Some(Err(error)) = log.as_mut().map(|log| log.write(&event)) {
                eprintln!("{error}; the log ends here");
                *log = None;
            }
            !signals::is_stop_requested()
        };
        let mut session = RefineSession::load(&capture, &self.options, init, on_event)?;
        if let (None, SceneInit::Photos, PhotoSize::Within(side)) =
            (self.options.gaussians, init, session.size)
        {
            let line = format!("{} Gaussians, photos of at most {side} pixels", session.gaussians);
            bar.bar.suspend(|| eprintln!("{line}; --gaussians and --size set others"));
        }
        // Depths of a subset of the photos are enough for an initial splat, too.
        signals::end_at_request(if matches!(init, SceneInit::Model(_)) { 1 } else { 2 });
        let gaussians = session.start()?;
        signals::end_at_request(2);
        if let (SceneInit::Photos, Some(quality)) = (init, session.quality()) {
            let line = format!("{}: {quality}", capture.name);
            if quality.verdict == Verdict::WillFail && !self.ignore_verdict {
                return Err(Error::failed(format!("{line}; --ignore-verdict refines all the same")).into());
            }
            bar.bar.suspend(|| eprintln!("{line}"));
        }
        *log.borrow_mut() =
            self.reports.log.as_ref().map(|folder| RefineLog::open(folder, steps)).transpose()?;
        if self.resume {
            let count = gaussians.count().max(session.gaussians as i64);
            session.reserve(STATE_TIME_PER_GAUSSIAN * count as u32);
        }
        if self.reports.contact_sheet.is_some() {
            session.reserve_for_contact_sheet(&gaussians)?;
        }
        keep_freed_memory();
        let mut result = session.run()?;
        bar.bar.finish_and_clear();
        if result.is_initial && result.steps > 0 {
            eprintln!("the initial splat reproduces the photos better: it is kept");
        }
        let cameras = capture.cameras();
        let spread = spread_over_path(&cameras, &(0..cameras.len()).collect::<Vec<_>>(), FITTED_CAMERAS);
        let spread: Vec<Camera> = spread.into_iter().map(|index| cameras[index]).collect();
        let read_origin = splat.as_ref().map_or(DVec3::ZERO, |splat| splat.origin);
        let origin = self.local_origin.choose(read_origin, || LocalFrame::from_cameras(&cameras).origin);
        let limits = ShLimits::up_to(result.splat.sh_degree);
        let fitted = fit_splat(&self.out, &result.splat, &limits, &spread)?;
        let mut state = result.state.take().filter(|_| self.resume);
        let mut save = |result: Option<&Splat>| -> Result<()> {
            let Some(state) = &mut state else { return Ok(()) };
            state.sources = vec![source.clone()];
            if let Some(splat) = result {
                state.sources.push(self.result_source(splat)?);
            }
            Ok(state.write(&state_file)?)
        };
        // A splat that is refined in place is its own source the next time. The state is written before it replaces its source, so that
        // a refinement that is killed in between can be continued.
        let is_source = self.splat.is_some();
        let saved = if is_source { save(Some(&fitted.with_origin(origin))) } else { Ok(()) };
        splat_out::write(&self.out, &fitted, origin, &WriteOptions::default())?;
        saved?;
        if !is_source {
            save(None)?;
        }
        let held_out = session.score_held_out(&result)?;
        if let Some(sheet) = &self.reports.contact_sheet {
            if signals::is_stop_requested() {
                eprintln!("{}: stopped before it was written", sheet.display());
            } else {
                report_downscaling(sheet, session.contact_sheet(&result)?.write(sheet)?);
            }
        }
        let lpips = if self.reports.lpips { session.score_lpips(&result)? } else { None };
        let mut output = self.describe_result(&session, &result, held_out.as_ref(), lpips.as_ref());
        output.json["transform"] = json!(transform);
        Ok(output)
    }

    /// Returns `true` if the initial Gaussians are a model's.
    fn is_from_model(&self) -> bool {
        self.weights.is_some() || self.init.as_deref() == Some("model")
    }

    /// Describes what the initial Gaussians come from, with the checksum of its files.
    fn source(&self) -> Result<String> {
        Ok(match (&self.splat, &self.weights) {
            (Some(splat), _) => splat_source(splat)?,
            (_, Some(weights)) => format!("the model with the checksum {:08x}", checksum([weights])?),
            _ if self.is_from_model() => "the bundled model".into(),
            _ => "the photos".into(),
        })
    }

    /// Describes the output of `splat` as the source of another refinement, before it is written.
    fn result_source(&self, splat: &Splat) -> Result<String> {
        let parent = parent_of(&self.out);
        let folder = tempfile::tempdir_in(parent).map_err(Error::write(parent))?;
        let copy = folder.path().join(self.out.file_name().unwrap_or_default());
        write_local_splat(&copy, splat, &WriteOptions::default())?;
        splat_source(&copy)
    }

    /// Describes the result. Scores are those before and after the optimization.
    fn describe_result(
        &self,
        session: &RefineSession,
        result: &RefineResult,
        held_out: Option<&[CaptureScores; 2]>,
        lpips: Option<&[CaptureScores; 2]>,
    ) -> Output {
        let RefineResult { steps, seconds: [begun, ended], train: [before, after], corrections, .. } = result;
        let (count, photos) = (result.gaussians.count(), session.photos().len());
        // Scores are of the held-out views if there are any, else of the photos.
        let distances =
            lpips.map_or([None; 2], |scores| scores.each_ref().map(|scores| scores.mean.lpips_vgg));
        let (of_photos, of_held_out) =
            if session.held_out().is_empty() { (distances, [None; 2]) } else { ([None; 2], distances) };
        let out = self.out.to_string_lossy();
        let of = |&Scores { psnr, cc_psnr, ssim, .. }: &Scores, lpips: Option<f64>| json!({ "psnr": psnr, "cc_psnr": cc_psnr, "ssim": ssim, "lpips_vgg": lpips });
        let mut json = json!({
            "splat": out, "gaussians": count, "photos": photos, "near_duplicates": session.near_duplicates,
            "steps": steps, "seconds": ended, "begin_seconds": begun, "corrections": corrections,
            "quality": session.quality(),
            "train": { "before": of(before, of_photos[0]), "after": of(after, of_photos[1]) },
        });
        let row = |name: String, [before, after]: [f64; 2], ssim: f64| {
            format!("{name:<24} {before:>14.2} {after:>8.2} {ssim:>8.4}")
        };
        let sampled = result.train_photos;
        let of_all_photos = if sampled < photos { format!("{sampled} of ") } else { String::new() };
        let mut lines = vec![
            format!("{out}: {count} Gaussians, {steps} steps, {ended:.0} s"),
            format!("{:<24} {:>14} {:>8} {:>8}", "", "PSNR before", "after", "SSIM"),
            row(format!("{of_all_photos}{photos} photos"), [before.psnr, after.psnr], after.ssim),
        ];
        if let Some([before, after]) = held_out {
            let scores = session.sample_scores(after);
            let last = EvalPoint { seconds: *ended, steps: *steps, scores };
            let curve: Vec<&EvalPoint> = result.curve.iter().chain([&last]).collect();
            let (scored, all) = (after.views.len(), session.held_out().len());
            json["held_out"] = json!({
                "views": scored, "before": of(&before.mean, of_held_out[0]),
                "after": of(&after.mean, of_held_out[1]), "curve": curve,
            });
            let of_all = if scored < all { format!(" of {all}") } else { String::new() };
            let psnr = [before.mean.psnr, after.mean.psnr];
            lines.push(row(format!("{scored}{of_all} views held out"), psnr, after.mean.ssim));
        }
        if let [Some(before), Some(after)] = distances {
            lines.push(format!("LPIPS (VGG) {before:.4} before, {after:.4} after"));
        }
        lines.extend(describe_corrections(corrections));
        Output::new(json, lines.join("\n"))
    }

    /// Returns an error if an output would replace an input, except the initial splat.
    fn check_outputs(&self, capture: &Capture, state: &Path) -> Result<()> {
        let mut inputs = InputFiles::default();
        capture.add_input_files(&mut inputs);
        self.weights.iter().for_each(|weights| inputs.add(weights));
        self.reports.log.iter().try_for_each(|log| inputs.check_folder(log))?;
        let outputs = [splat_files(&self.out), vec![state.to_owned()]].concat();
        outputs.iter().try_for_each(|file| inputs.check_file(file))?;
        self.splat.iter().for_each(|splat| inputs.add_all(splat_files(splat)));
        inputs.add_all(outputs);
        Ok(self.reports.contact_sheet.iter().try_for_each(|sheet| inputs.check_file(sheet))?)
    }
}

/// Describes the splat at `path` as the source of a refinement.
fn splat_source(path: &Path) -> Result<String> {
    let files = splat_files(path).into_iter().filter(|file| file.is_file());
    Ok(format!("the splat with the checksum {:08x}", checksum(files)?))
}

/// Progress bar of a session.
struct Bar {
    bar: Progress,
    budget: Budget,
    clock: Instant,
}

impl Bar {
    fn new(budget: Budget, clock: Instant) -> Self {
        let bar = match budget {
            Budget::Steps(steps) => progress::bar(steps, "steps"),
            Budget::Time(time) => progress::time_bar(time),
        };
        Bar { bar, budget, clock }
    }

    fn update(&self, event: RefineEvent) {
        let message = match event {
            RefineEvent::Loading { done, count } => format!("{done} of {count} photos read"),
            RefineEvent::Starting(done) => format!("depths found in {done} photos"),
            RefineEvent::Optimizing { steps, psnr } => match psnr {
                Some(psnr) => format!("{steps} steps, held out {psnr:.2} dB"),
                None => format!("{steps} steps"),
            },
            RefineEvent::Scoring(_) | RefineEvent::Measured { .. } | RefineEvent::Scored(_) => return,
            RefineEvent::Warning(line) => return self.bar.suspend(|| eprintln!("{line}")),
        };
        self.bar.set_message(message);
        match (event, self.budget) {
            (RefineEvent::Optimizing { steps, .. }, Budget::Steps(_)) => {
                // The time of the initialization says nothing about the rate of the steps.
                if self.bar.position() == 0 {
                    self.bar.reset_eta();
                }
                self.bar.set_position(steps);
            }
            (_, Budget::Time(_)) => self.bar.set_position(self.clock.elapsed().as_secs()),
            _ => {}
        }
    }
}

/// Describes the largest learned corrections in one line, or returns `None` if there are none.
fn describe_corrections(corrected: &[Correction]) -> Option<String> {
    let largest = |number: fn(&Correction) -> f64| corrected.iter().map(number).reduce(f64::max);
    let factor = |of: &Correction| of.exposure.map(|gain| gain.max(1. / gain)).into_iter().fold(1., f64::max);
    let (degrees, depths, factor) = (largest(|of| of.degrees)?, largest(|of| of.depths)?, largest(factor)?);
    let cameras = format!("{degrees:.2}° and {depths:.4} of the scene's depth (cameras)");
    let exposures = format!("a factor of {factor:.3} (exposures)");
    let kinds = [(degrees > 0. || depths > 0., cameras), (factor > 1., exposures)];
    let changed: Vec<String> =
        kinds.into_iter().filter(|(is_any, _)| *is_any).map(|(_, line)| line).collect();
    (!changed.is_empty()).then(|| format!("corrected at most by: {}", changed.join(", ")))
}
