use super::progress::{self, Progress};
use super::{
    FAILED, check_views, device, memory, model, open_capture, parse_size, print_json, say_shrunk, signals,
    splat_out, warn,
};
use anyhow::Result;
use clap::{Args, ValueEnum};
use globalsplat::data::{Capture, Holdout, View};
use globalsplat::error::Error;
use globalsplat::eval::{CaptureScores, ContactSheet, Perceptual, process_age, score_views};
use globalsplat::io::{
    InputFiles, check_writable_png, check_writable_splat, read_splat, splat_files, weights_files,
};
use globalsplat::model::Precision;
use globalsplat::reconstruct::spread_over_path;
use globalsplat::refine::{
    Budget, Correction, Initial, MIN_SIDE, PatchScores, RefineConfig, RefineEvent, RefineOptions,
    RefineResult, RefineSession, SpaceKind,
};
use globalsplat::render::render_views;
use globalsplat::scene::{Camera, Gaussians, LocalFrame};
use serde_json::{Value, json};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Default number of Gaussians, equal to that of the paper's main model.
pub const DEFAULT_GAUSSIANS: u32 = 16_384;
/// Message if the user stops the program before there is a splat.
const NOTHING_YET: &str = "stopped before there was a splat: nothing is written";
/// Maximum of `--seconds`: a year.
const MAX_SECONDS: f64 = 365. * 24. * 3600.;
/// Maximum share of the time budget for scoring the held-out views, before and after.
const SCORING_SHARE: f64 = 0.05;
/// Estimated time to write a splat and exit: a constant, and the time per Gaussian.
const WRITING: Duration = Duration::from_millis(200);
const WRITING_GAUSSIAN: Duration = Duration::from_micros(2);
/// Maximum number of cameras for which a splat's colours are fitted to the range of its file format.
const FITTED_CAMERAS: usize = 64;
/// Maximum number of photos that LPIPS compares if no views are held out.
const LPIPS_PHOTOS: usize = 8;

/// Optimize a splat on the photos of its scene, or create one from the photos alone.
///
/// The Gaussians, whose number stays fixed, are optimized until their renders match the photos. Without --splat they are
/// initialized where the depths of several photos agree; neither weights nor a GPU are needed. Ctrl-C ends the optimization
/// early and writes the current splat.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat refine --scene captures/room --out room.ply\n  \
    globalsplat refine --splat room.ply --scene captures/room --out better.ply --seconds 30\n  \
    globalsplat refine --scene captures/room --holdout every:8 --sheet views.png --out room.ply")]
pub struct Refine {
    /// Initial splat, in the capture's world coordinates: .ply, .compressed.ply, .spz or .splat
    #[arg(long, value_name = "FILE", conflicts_with = "gaussians")]
    pub splat: Option<PathBuf>,
    /// Initialization without --splat: from the photos alone, or from a model's reconstruction
    #[arg(long, value_enum, conflicts_with = "splat")]
    pub from: Option<From>,
    /// Weights of the initial model, as `globalsplat export` writes them; by default the weights embedded in this program
    #[arg(long, value_name = "FILE", conflicts_with = "splat")]
    pub weights: Option<PathBuf>,
    /// Optimized parameters: Gaussians, the tokens that a model decodes them from, or both: first tokens, then Gaussians
    #[arg(long, value_enum, default_value_t = SpaceName::Gaussians, conflicts_with = "splat")]
    pub space: SpaceName,
    /// Capture: a folder with a cameras.json, a transforms.json or a COLMAP model, or CHUNK.torch#KEY
    #[arg(long, value_name = "PATH")]
    pub scene: PathBuf,
    /// Output splat: .ply, .compressed.ply, .spz or .splat
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Write coordinates relative to the centre of the cameras, which is stored in a file beside the splat: far from the
    /// world's origin, as in UTM coordinates, float32 loses detail
    #[arg(long)]
    pub local_origin: bool,
    /// Number of Gaussians, not allowed with --splat; a model's reconstruction may have more
    #[arg(long, value_name = "N", default_value_t = DEFAULT_GAUSSIANS, value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    pub gaussians: u32,
    /// Total time in seconds, from the start of the program to its end
    #[arg(long, value_name = "S", default_value_t = 60., conflicts_with = "steps")]
    pub seconds: f64,
    /// Number of steps, instead of a time: the same steps and seed give the same bytes
    #[arg(long, value_name = "N")]
    pub steps: Option<u64>,
    /// Seed of the random numbers
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub seed: u64,
    /// Views to hold out and score: every:N, every:N+K, or none for only the capture's own test split
    #[arg(long, value_name = "WHICH", default_value = "none")]
    pub holdout: String,
    /// Maximum number of the other views, spread along the camera path
    #[arg(long, value_name = "N")]
    pub views: Option<usize>,
    /// Crop and resize photos to this size; by default they keep their aspect ratio, with at most 512 pixels along the longer
    /// side
    #[arg(long, value_name = "WxH")]
    pub size: Option<String>,
    /// Also optimize a correction of each camera's pose
    #[arg(long)]
    pub correct_poses: bool,
    /// Also optimize a correction of each photo's exposure and white balance
    #[arg(long)]
    pub correct_exposures: bool,
    /// Also write an image: photo, render and depth side by side, a row per held-out view, or else per view
    #[arg(long, value_name = "FILE.png")]
    pub sheet: Option<PathBuf>,
    /// Also score by LPIPS, before and after, if its weights are found; this takes additional time, after the splat is written
    #[arg(long)]
    pub lpips: bool,
    /// Override a setting of the method, as in views=4; docs/refine.md lists them
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Device of the optimization: cpu, cuda or cuda:N
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    pub device: String,
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Initialization of the optimization.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum From {
    /// Pixels at which the depths of the photos agree
    Nothing,
    /// A model's reconstruction, and pixels for the Gaussians that it lacks to --gaussians
    Weights,
}

/// Parameters that are optimized.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SpaceName {
    /// Each Gaussian by itself
    Gaussians,
    /// Tokens of a model
    Tokens,
    /// Tokens first, then Gaussians
    Both,
}

impl From {
    fn needs_model(asked: &Refine) -> Result<bool> {
        let needs_model = asked.weights.is_some() || asked.space != SpaceName::Gaussians;
        if asked.from == Some(From::Nothing) && needs_model {
            let why = "--from nothing has neither weights nor tokens; --from weights has";
            return Err(Error::request(why).into());
        }
        Ok(needs_model || asked.from == Some(From::Weights))
    }
}

impl Refine {
    pub fn run(self) -> Result<()> {
        let clock = Instant::now();
        let clock = clock.checked_sub(process_age().unwrap_or_default()).unwrap_or(clock);
        memory::keep();
        check_views(self.views)?;
        let holdout = self.holdout.parse::<Holdout>().map_err(Error::request)?;
        let options = self.options()?;
        let needs_model = From::needs_model(&self)?;
        if self.space == SpaceName::Tokens && (self.correct_poses || self.correct_exposures) {
            let why = "--space tokens corrects no photos; --correct-poses and --correct-exposures go with gaussians or both";
            return Err(Error::request(why).into());
        }
        check_writable_splat(&self.out)?;
        splat_out::check_origin(&self.out, self.local_origin)?;
        if let Some(sheet) = &self.sheet {
            check_writable_png(sheet)?;
        }
        let stop = StopRequest::install()?;
        let capture = open_capture(&self.scene)?;
        self.check_outputs(&capture)?;
        let splat = self.splat.as_deref().map(read_splat).transpose()?;
        if let Some(splat) = &splat {
            warn(&splat.warnings);
        }
        let initial_gaussians = splat.as_ref().map(|splat| (Gaussians::from_splat(splat), splat.origin));
        let loaded = needs_model
            .then(|| model::load(self.weights.as_deref(), Some(Precision::F32), options.device))
            .transpose()?;
        let (shown, held_out) = capture.split(holdout);
        let cameras = capture.cameras();
        let shown = spread_over_path(&cameras, &shown, self.views.unwrap_or(usize::MAX).max(1));
        let bar = Bar {
            bar: bar_of(&options.budget),
            budget: options.budget,
            clock,
            count: shown.len() + held_out.len(),
        };
        let watch = |event: RefineEvent| {
            bar.tell(event);
            !stop.is_requested()
        };
        let mut session = RefineSession::load(&capture, &shown, &held_out, &options, clock, watch)?;
        let initial = match (&initial_gaussians, &loaded) {
            (Some((gaussians, origin)), _) => Initial::Splat(gaussians, *origin),
            (None, Some(loaded)) => Initial::Model { loaded, views: self.views },
            (None, None) => Initial::Photos,
        };
        // Depths of a subset of the photos are enough for an initial splat, too.
        stop.set_ends_at_once(loaded.is_some());
        let initial = session.start(initial)?;
        stop.set_ends_at_once(false);
        bar.bar.suspend(|| session.warnings().iter().for_each(|warning| eprintln!("{warning}")));

        let scorer = Scorer { name: &capture.name, stop: &stop };
        let scored = scorer.affordable(&initial, session.held_out(), options.budget)?;
        let begun = Instant::now();
        let before = scorer.score(&initial, &scored)?;
        session.reserve(begun.elapsed() + self.time_after(&session, &initial)?);
        if let Some(line) = session.late_start_warning() {
            bar.bar.suspend(|| eprintln!("{line}"));
        }
        let result = session.run()?;
        bar.bar.finish_and_clear();
        if result.is_initial && result.steps > 0 {
            eprintln!("the initial splat reproduces the photos better: it is kept");
        }
        let spread = spread_over_path(&cameras, &(0..cameras.len()).collect::<Vec<_>>(), FITTED_CAMERAS);
        let spread: Vec<Camera> = spread.into_iter().map(|index| cameras[index]).collect();
        // An unchanged splat is written as it was read.
        let refined;
        let written = match splat.as_ref().filter(|_| result.is_initial) {
            Some(splat) => splat,
            None => {
                let (gaussians, origin) = session.to_world(&result.gaussians);
                refined = gaussians.to_splat(origin)?;
                &refined
            }
        };
        let origin = self.local_origin.then(|| LocalFrame::from_cameras(&cameras).origin);
        splat_out::write_for(&self.out, written, &spread, origin)?;
        let after =
            if result.is_initial { before.clone() } else { scorer.score(&result.gaussians, &scored)? };
        let held_out = before.zip(after);
        if let Some(sheet) = &self.sheet {
            if stop.is_requested() {
                eprintln!("{}: stopped before it was written", sheet.display());
            } else {
                let rows = sheet_of(&result.gaussians, sheet_views(&session))?;
                say_shrunk(sheet, rows.write(sheet)?);
            }
        }
        let lpips = if self.lpips { scorer.lpips(&initial, &result.gaussians, &session)? } else { None };
        self.print(&session, &result, held_out.as_ref(), lpips);
        Ok(())
    }

    fn options(&self) -> Result<RefineOptions> {
        let size = self.size.as_deref().map(parse_size).transpose()?;
        if let Some(size) = size
            && size.width.min(size.height) < MIN_SIDE
        {
            let (width, height) = (size.width, size.height);
            let why = format!("--size {width}x{height}: expected {MIN_SIDE} pixels or more along each side");
            return Err(Error::request(why).into());
        }
        if !(self.seconds > 0. && self.seconds <= MAX_SECONDS) {
            let why = format!("--seconds is {}, expected more than 0, up to a year", self.seconds);
            return Err(Error::request(why).into());
        }
        Ok(RefineOptions {
            config: RefineConfig::with(&self.set, self.splat.is_some())?,
            space: match self.space {
                SpaceName::Gaussians => SpaceKind::Gaussians,
                SpaceName::Tokens => SpaceKind::Tokens,
                SpaceName::Both => SpaceKind::Both,
            },
            budget: match self.steps {
                Some(steps) => Budget::Steps(steps),
                None => Budget::Time(Duration::from_secs_f64(self.seconds)),
            },
            gaussians: self.gaussians as usize,
            seed: self.seed,
            correct_poses: self.correct_poses,
            correct_exposures: self.correct_exposures,
            size,
            device: device::parse(&self.device)?,
        })
    }

    /// Estimates the time for writing the splat and the sheet, after the optimization.
    fn time_after(&self, session: &RefineSession, gaussians: &Gaussians) -> Result<Duration> {
        let count = gaussians.count().max(i64::from(self.gaussians)) as u32;
        let mut time = WRITING + WRITING_GAUSSIAN * count;
        if self.sheet.is_some() {
            let views = sheet_views(session);
            let begun = Instant::now();
            let _ = sheet_of(gaussians, &views[..1])?;
            time += begun.elapsed() * views.len() as u32;
        }
        Ok(time)
    }

    fn print(
        &self,
        session: &RefineSession,
        result: &RefineResult,
        held_out: Option<&(CaptureScores, CaptureScores)>,
        lpips: Option<[CaptureScores; 2]>,
    ) {
        let RefineResult { steps, seconds: [begun, ended], shown: [before, after], corrections, .. } = result;
        let (count, photos) = (result.gaussians.count(), session.photos().len());
        // Scores are of the held-out views if there are any, else of the photos.
        let distances = lpips.map(|scores| scores.map(|scores| scores.lpips_vgg)).unwrap_or_default();
        let (of_photos, of_held_out) =
            if session.held_out().is_empty() { (distances, [None; 2]) } else { ([None; 2], distances) };
        let scores = |psnr: f64, ssim: f64, lpips: Option<f64>| json!({ "psnr": psnr, "ssim": ssim, "lpips_vgg": lpips });
        if self.json {
            let of = |scores_of: &PatchScores, lpips| scores(scores_of.psnr, scores_of.ssim, lpips);
            let mut object = json!({
                "splat": self.out.to_string_lossy(), "gaussians": count, "photos": photos, "near_duplicates": session.near_duplicates(),
                "steps": steps, "seconds": ended, "begin_seconds": begun, "corrections": corrections,
                "shown": { "before": of(before, of_photos[0]), "after": of(after, of_photos[1]) },
            });
            if let Some((before, after)) = held_out {
                let of = |scores_of: &CaptureScores, lpips| scores(scores_of.psnr, scores_of.ssim, lpips);
                let last =
                    json!({ "seconds": ended, "steps": steps, "psnr": after.psnr, "ssim": after.ssim });
                let mut curve: Vec<Value> = result.curve.iter().map(|point| json!(point)).collect();
                curve.push(last);
                object["held_out"] = json!({
                    "views": after.views.len(), "before": of(before, of_held_out[0]),
                    "after": of(after, of_held_out[1]), "curve": curve,
                });
            }
            print_json(&object);
            return;
        }
        println!("{}: {count} Gaussians, {steps} steps, {ended:.0} s", self.out.display());
        println!("{:<24} {:>14} {:>8} {:>8}", "", "PSNR before", "after", "SSIM");
        let row = |name: String, [before, after]: [f64; 2], ssim: f64| {
            println!("{name:<24} {before:>14.2} {after:>8.2} {ssim:>8.4}");
        };
        row(format!("{photos} photos, patches"), [before.psnr, after.psnr], after.ssim);
        if let Some((before, after)) = held_out {
            let (scored, all) = (after.views.len(), session.held_out().len());
            let of_all = if scored < all { format!(" of {all}") } else { String::new() };
            row(format!("{scored}{of_all} views held out"), [before.psnr, after.psnr], after.ssim);
        }
        if let [Some(before), Some(after)] = distances {
            println!("LPIPS (VGG) {before:.4} before, {after:.4} after");
        }
        if let Some(line) = told_of(corrections) {
            println!("{line}");
        }
    }

    /// Returns an error if an output would replace an input, except the initial splat.
    fn check_outputs(&self, capture: &Capture) -> Result<()> {
        let mut inputs = InputFiles::default();
        capture.add_input_files(&mut inputs);
        self.weights.iter().for_each(|path| inputs.add_all(weights_files(path)));
        inputs.check_file(&self.out)?;
        self.splat.iter().chain([&self.out]).for_each(|splat| inputs.add_all(splat_files(splat)));
        Ok(self.sheet.iter().try_for_each(|sheet| inputs.check_file(sheet))?)
    }
}

/// Request of the user or the system to stop, by Ctrl-C or SIGTERM.
#[derive(Clone, Default)]
struct StopRequest {
    is_requested: Arc<AtomicBool>,
    ends_at_once: Arc<AtomicBool>,
}

impl StopRequest {
    /// Installs the signal handlers. The first request ends the process immediately as long as there is no splat to keep, a
    /// second one at any time: files are written whole or not at all.
    fn install() -> Result<Self> {
        let request = StopRequest::default();
        request.set_ends_at_once(true);
        let handler = request.clone();
        signals::on_stop(move || {
            let is_second = handler.is_requested.swap(true, Ordering::Relaxed);
            if is_second || handler.ends_at_once.load(Ordering::Relaxed) {
                eprintln!("globalsplat: {}", if is_second { "stopped at once" } else { NOTHING_YET });
                // SAFETY: `_exit` ends the process without running destructors of libraries, which would wait for the working
                // threads.
                unsafe { libc::_exit(FAILED.into()) }
            }
        })?;
        Ok(request)
    }

    fn set_ends_at_once(&self, ends: bool) {
        self.ends_at_once.store(ends, Ordering::Relaxed);
    }

    fn is_requested(&self) -> bool {
        self.is_requested.load(Ordering::Relaxed)
    }
}

/// Progress bar of a session.
struct Bar {
    bar: Progress,
    budget: Budget,
    clock: Instant,
    /// Number of photos to read.
    count: usize,
}

fn bar_of(budget: &Budget) -> Progress {
    match *budget {
        Budget::Steps(steps) => progress::bar(steps, "steps"),
        Budget::Time(time) => progress::seconds_of(time),
    }
}

impl Bar {
    fn tell(&self, event: RefineEvent) {
        let message = match event {
            RefineEvent::Loading(done) => format!("{done} of {} photos read", self.count),
            RefineEvent::Starting(done) => format!("depths found in {done} photos"),
            RefineEvent::Optimizing { steps, psnr } => match psnr {
                Some(psnr) => format!("{steps} steps, held out {psnr:.2} dB"),
                None => format!("{steps} steps"),
            },
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

/// Scores splats on views of a capture, until the user asks to stop.
struct Scorer<'a> {
    name: &'a str,
    stop: &'a StopRequest,
}

impl Scorer<'_> {
    /// Returns an evenly spaced subset of `views` that can be scored within [`SCORING_SHARE`] of the time budget.
    fn affordable(&self, gaussians: &Gaussians, views: &[View], budget: Budget) -> Result<Vec<View>> {
        let every = match budget {
            Budget::Time(time) if !views.is_empty() => {
                let begun = Instant::now();
                self.score(gaussians, &views[..1])?;
                let all = begun.elapsed() * views.len() as u32;
                all.div_duration_f64(time.mul_f64(SCORING_SHARE)).ceil().max(1.) as usize
            }
            _ => 1,
        };
        Ok(views.iter().step_by(every).map(View::shallow_clone).collect())
    }

    fn score(&self, gaussians: &Gaussians, views: &[View]) -> Result<Option<CaptureScores>> {
        let go_on = |_| !self.stop.is_requested();
        let scores = score_views(self.name, gaussians, views, None, go_on)?;
        Ok(scores.filter(|scores| scores.views.len() == views.len()))
    }

    /// Computes LPIPS before and after: on the held-out views, or else on a few photos. Returns `None` if the user asks to
    /// stop.
    fn lpips(
        &self,
        before: &Gaussians,
        after: &Gaussians,
        session: &RefineSession,
    ) -> Result<Option<[CaptureScores; 2]>> {
        let perceptual = Perceptual::find(before.means.device())?;
        let views = match session.held_out() {
            [] => &session.photos()[..session.photos().len().min(LPIPS_PHOTOS)],
            views => views,
        };
        let score = |gaussians| {
            let go_on = |_| !self.stop.is_requested();
            score_views(self.name, gaussians, views, Some(&perceptual), go_on)
        };
        let (Some(before), Some(after)) = (score(before)?, score(after)?) else { return Ok(None) };
        if let Some(line) = perceptual.why_absent(&after) {
            eprintln!("{line}");
        }
        Ok((before.views.len() == after.views.len()).then_some([before, after]))
    }
}

/// Returns the views that have a row in the sheet: the held-out views, or else all photos.
fn sheet_views<'a>(session: &'a RefineSession) -> &'a [View] {
    if session.held_out().is_empty() { session.photos() } else { session.held_out() }
}

fn sheet_of(gaussians: &Gaussians, views: &[View]) -> globalsplat::Result<ContactSheet> {
    let mut rows = ContactSheet::new(views.len());
    for view in views {
        rows.add(&view.image, &render_views(gaussians, &[view.camera])?[0].to_host())?;
    }
    Ok(rows)
}

/// Describes the largest learned corrections in one line, or returns `None` if there are none.
fn told_of(corrected: &[Correction]) -> Option<String> {
    let largest = |number: fn(&Correction) -> f64| corrected.iter().map(number).reduce(f64::max);
    let factor = |of: &Correction| of.exposure.map(|gain| gain.max(1. / gain)).into_iter().fold(1., f64::max);
    Some(format!(
        "corrected at most by: {:.2}° and {:.4} of the scene's depth (cameras), a factor of {:.3} (exposures)",
        largest(|of| of.degrees)?,
        largest(|of| of.depths)?,
        largest(factor)?,
    ))
}
