//! A refinement with its files: reads the inputs, shows the progress, and writes the outputs.

use super::super::capture::SceneSource;
use super::super::progress::{self, Progress};
use super::super::signals::StopRequest;
use super::super::{model, open_masked_capture, report_downscaling, splat_out, warn};
use super::report::print_result;
use anyhow::Result;
use clap::Args;
use globalsplat::data::{Capture, PhotoSize};
use globalsplat::device::process_age;
use globalsplat::io::{
    InputFiles, check_writable_dir, check_writable_file, check_writable_png, check_writable_splat,
    read_splat, splat_files,
};
use globalsplat::model::Precision;
use globalsplat::reconstruct::spread_over_path;
use globalsplat::refine::{
    Budget, Initial, RefineEvent, RefineLog, RefineOptions, RefineSession, RefineState,
};
use globalsplat::scene::{Camera, LocalFrame};
use std::cell::RefCell;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Maximum number of cameras for which a splat's colours are fitted to the range of its file format.
const FITTED_CAMERAS: usize = 64;

/// Estimated time for writing the state of an optimization, per Gaussian.
const STATE_TIME_PER_GAUSSIAN: Duration = Duration::from_micros(1);

/// Source of the initial Gaussians.
pub enum InitialFile {
    /// Photos alone.
    Photos,
    /// Splat in a file.
    Splat(PathBuf),
    /// Model in a file of weights, or the one embedded in this program.
    Model(Option<PathBuf>),
}

/// Refinement of a capture, with its files and what is reported.
pub struct RefineJob {
    pub scene: SceneSource,
    pub masks: Option<PathBuf>,
    pub out: PathBuf,
    pub initial: InitialFile,
    /// Options, of which the number of Gaussians and the size of the photos are replaced by the following ones.
    pub options: RefineOptions,
    /// Number of Gaussians; if it is `None`, one that suits the time, the machine and the photos.
    pub gaussians: Option<usize>,
    /// Size of the photos; if it is `None`, one that suits the number of Gaussians.
    pub size: Option<PhotoSize>,
    /// `true` to continue from the state beside the output, if there is one, and to write it.
    pub resume: bool,
    pub local_origin: bool,
    pub reports: Reports,
    pub json: bool,
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
    sheet: Option<PathBuf>,
    /// Also score by LPIPS, before and after, if its weights are found; this takes additional time, after the splat is written
    #[arg(long)]
    lpips: bool,
}

impl RefineJob {
    pub fn run(mut self) -> Result<()> {
        let age = process_age().unwrap_or_default();
        let now = Instant::now();
        check_writable_splat(&self.out)?;
        splat_out::check_origin(&self.out, self.local_origin)?;
        if let Some(sheet) = &self.reports.sheet {
            check_writable_png(sheet)?;
        }
        let state_file = RefineState::path_for(&self.out);
        if self.resume {
            check_writable_file(&state_file)?;
        }
        if let Some(log) = &self.reports.log {
            check_writable_dir(log)?;
        }
        let stop = StopRequest::install()?;
        let path = self.scene.path(self.masks.as_deref(), &self.out, &stop)?;
        // The time budget begins after the poses of photos are found.
        let clock = match self.scene.is_unposed() {
            true => Instant::now(),
            false => now.checked_sub(age).unwrap_or(now),
        };
        self.options.started = Some(clock);
        let capture = open_masked_capture(&path, self.masks.as_deref())?;
        self.check_outputs(&capture)?;
        let (mut splat, mut loaded, mut state) = (None, None, None);
        let initial = match &self.initial {
            _ if self.resume && state_file.exists() => {
                let state = state.insert(RefineState::read(&state_file)?);
                eprintln!("{}: continues after {} steps", state_file.display(), state.steps());
                Initial::State(state)
            }
            InitialFile::Photos => Initial::Photos,
            InitialFile::Splat(path) => {
                let splat = splat.insert(read_splat(path)?);
                warn(&splat.warnings);
                Initial::Splat(splat)
            }
            InitialFile::Model(weights) => {
                let load = model::load(weights.as_deref(), Some(Precision::F32), self.options.device);
                Initial::Model(loaded.insert(load?))
            }
        };
        let chosen = self.choose_sizes(&capture, &initial);
        let bar = Bar { bar: bar_of(&self.options.budget), budget: self.options.budget, clock };
        let steps = if let Initial::State(state) = initial { state.steps() } else { 0 };
        let log = self.reports.log.as_ref().map(|folder| RefineLog::create(folder, steps)).transpose()?;
        let log = RefCell::new(log);
        let on_event = |event: RefineEvent| {
            bar.tell(event);
            write_event(&mut log.borrow_mut(), event);
            !stop.is_requested()
        };
        let mut session = RefineSession::load(&capture, &self.options, on_event)?;
        if let Some(line) = chosen {
            bar.bar.suspend(|| eprintln!("{line}"));
        }
        // Depths of a subset of the photos are enough for an initial splat, too.
        stop.set_ends_at_once(matches!(initial, Initial::Model(_)));
        let gaussians = session.start(initial)?;
        stop.set_ends_at_once(false);
        if self.resume {
            session.reserve(
                STATE_TIME_PER_GAUSSIAN * gaussians.count().max(self.options.gaussians as i64) as u32,
            );
        }
        if self.reports.sheet.is_some() {
            session.reserve_for_contact_sheet(&gaussians)?;
        }
        let result = session.run()?;
        bar.bar.finish_and_clear();
        if result.is_initial && result.steps > 0 {
            eprintln!("the initial splat reproduces the photos better: it is kept");
        }
        let cameras = capture.cameras();
        let spread = spread_over_path(&cameras, &(0..cameras.len()).collect::<Vec<_>>(), FITTED_CAMERAS);
        let spread: Vec<Camera> = spread.into_iter().map(|index| cameras[index]).collect();
        let origin = self.local_origin.then(|| LocalFrame::from_cameras(&cameras).origin);
        splat_out::write_for(&self.out, &result.splat, &spread, origin)?;
        if let (true, Some(state)) = (self.resume, &result.state) {
            state.write(&state_file)?;
        }
        let held_out = session.score_held_out(&result)?;
        if let Some(sheet) = &self.reports.sheet {
            if stop.is_requested() {
                eprintln!("{}: stopped before it was written", sheet.display());
            } else {
                report_downscaling(sheet, session.contact_sheet(&result)?.write(sheet)?);
            }
        }
        let lpips = if self.reports.lpips { session.score_lpips(&result)? } else { None };
        print_result(&self.out, self.json, &session, &result, held_out.as_ref(), lpips.as_ref());
        Ok(())
    }

    /// Sets the number of Gaussians and the size of the photos. Returns a line about what was chosen.
    fn choose_sizes(&mut self, capture: &Capture, initial: &Initial) -> Option<String> {
        let gaussians = match initial {
            Initial::Splat(splat) => splat.len().max(1),
            Initial::State(state) if matches!(self.initial, InitialFile::Splat(_)) => state.count(),
            _ => self.gaussians.unwrap_or_else(|| self.options.gaussians_for(capture)),
        };
        let size = self.size.unwrap_or(RefineOptions::size_for(gaussians));
        self.options = RefineOptions { gaussians, size, ..self.options.clone() };
        let (None, Initial::Photos, PhotoSize::Within(side)) = (self.gaussians, initial, size) else {
            return None;
        };
        Some(format!(
            "{gaussians} Gaussians, photos of at most {side} pixels; --gaussians and --size set others"
        ))
    }

    /// Returns an error if an output would replace an input, except the initial splat.
    fn check_outputs(&self, capture: &Capture) -> Result<()> {
        let mut inputs = InputFiles::default();
        capture.add_input_files(&mut inputs);
        if let InitialFile::Model(Some(weights)) = &self.initial {
            inputs.add(weights);
        }
        inputs.check_file(&self.out)?;
        if let InitialFile::Splat(splat) = &self.initial {
            inputs.add_all(splat_files(splat));
        }
        inputs.add_all(splat_files(&self.out));
        Ok(self.reports.sheet.iter().try_for_each(|sheet| inputs.check_file(sheet))?)
    }
}

/// Writes metrics and scores to the log, if there is one. If that fails, says so and ends the log.
fn write_event(log: &mut Option<RefineLog>, event: RefineEvent) {
    let Some(open) = log else { return };
    let written = match event {
        RefineEvent::Measured(metrics) => open.log_step(metrics),
        RefineEvent::Scored(point) => open.log_scores(point),
        _ => return,
    };
    if let Err(why) = written {
        eprintln!("{why}; the log ends here");
        *log = None;
    }
}

/// Progress bar of a session.
struct Bar {
    bar: Progress,
    budget: Budget,
    clock: Instant,
}

fn bar_of(budget: &Budget) -> Progress {
    match *budget {
        Budget::Steps(steps) => progress::bar(steps, "steps"),
        Budget::Time(time) => progress::time_bar(time),
    }
}

impl Bar {
    fn tell(&self, event: RefineEvent) {
        let message = match event {
            RefineEvent::Loading { done, count } => format!("{done} of {count} photos read"),
            RefineEvent::Starting(done) => format!("depths found in {done} photos"),
            RefineEvent::Optimizing { steps, psnr } => match psnr {
                Some(psnr) => format!("{steps} steps, held out {psnr:.2} dB"),
                None => format!("{steps} steps"),
            },
            RefineEvent::Scoring(_) | RefineEvent::Measured(_) | RefineEvent::Scored(_) => return,
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
