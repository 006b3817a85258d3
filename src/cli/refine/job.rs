//! A refinement with its files: reads the inputs, shows the progress, and writes the outputs.

use super::super::capture::SceneSource;
use super::super::progress::{self, Progress};
use super::super::signals::StopRequest;
use super::super::{memory, model, open_masked_capture, report_downscaling, splat_out, warn};
use super::report::print_result;
use anyhow::Result;
use globalsplat::data::Capture;
use globalsplat::eval::process_age;
use globalsplat::io::{
    InputFiles, check_writable_png, check_writable_splat, read_splat, splat_files, weights_files,
};
use globalsplat::model::Precision;
use globalsplat::reconstruct::spread_over_path;
use globalsplat::refine::{Budget, Initial, RefineEvent, RefineOptions, RefineSession};
use globalsplat::scene::{Camera, LocalFrame};
use std::path::PathBuf;
use std::time::Instant;

/// Maximum number of cameras for which a splat's colours are fitted to the range of its file format.
const FITTED_CAMERAS: usize = 64;

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
    pub options: RefineOptions,
    pub local_origin: bool,
    pub sheet: Option<PathBuf>,
    pub lpips: bool,
    pub json: bool,
}

impl RefineJob {
    pub fn run(mut self) -> Result<()> {
        let age = process_age().unwrap_or_default();
        let now = Instant::now();
        memory::keep();
        check_writable_splat(&self.out)?;
        splat_out::check_origin(&self.out, self.local_origin)?;
        if let Some(sheet) = &self.sheet {
            check_writable_png(sheet)?;
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
        let (mut splat, mut loaded) = (None, None);
        let initial = match &self.initial {
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
        let bar = Bar { bar: bar_of(&self.options.budget), budget: self.options.budget, clock };
        let on_event = |event: RefineEvent| {
            bar.tell(event);
            !stop.is_requested()
        };
        let mut session = RefineSession::load(&capture, &self.options, on_event)?;
        // Depths of a subset of the photos are enough for an initial splat, too.
        stop.set_ends_at_once(matches!(initial, Initial::Model(_)));
        let gaussians = session.start(initial)?;
        stop.set_ends_at_once(false);
        if self.sheet.is_some() {
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
        let held_out = session.score_held_out(&result)?;
        if let Some(sheet) = &self.sheet {
            if stop.is_requested() {
                eprintln!("{}: stopped before it was written", sheet.display());
            } else {
                report_downscaling(sheet, session.contact_sheet(&result)?.write(sheet)?);
            }
        }
        let lpips = if self.lpips { session.score_lpips(&result)? } else { None };
        print_result(&self.out, self.json, &session, &result, held_out.as_ref(), lpips.as_ref());
        Ok(())
    }

    /// Returns an error if an output would replace an input, except the initial splat.
    fn check_outputs(&self, capture: &Capture) -> Result<()> {
        let mut inputs = InputFiles::default();
        capture.add_input_files(&mut inputs);
        if let InitialFile::Model(Some(weights)) = &self.initial {
            inputs.add_all(weights_files(weights));
        }
        inputs.check_file(&self.out)?;
        if let InitialFile::Splat(splat) = &self.initial {
            inputs.add_all(splat_files(splat));
        }
        inputs.add_all(splat_files(&self.out));
        Ok(self.sheet.iter().try_for_each(|sheet| inputs.check_file(sheet))?)
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
            RefineEvent::Scoring(_) => return,
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
