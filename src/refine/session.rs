//! Refinement session from a capture to Gaussians: reads the photos, creates the initial Gaussians, optimizes them, and scores them on a
//! few views during the optimization. All of it shares one budget and uses a local frame of the capture (spec 2.5).

use super::config::RefineConfig;
use super::events::{EvalPoint, RefineEvent};
use super::exposures::LogGains;
use super::gaussian_optimizer::GaussianOptimizer;
use super::init::{PhotoInit, SceneInit, gaussians_from_photos};
use super::options::{Budget, ExposureCorrection, RefineOptions, TimeBudget};
use super::photo_opt::{Correction, PhotoOpt};
use super::photos::{Photos, distinct, load_photos, longest_side};
use super::state::{Record, RefineState};
use super::{OptimizeArgs, refine, scene_depth};
use crate::data::{Capture, PhotoSize, Point, View, read_points};
use crate::device::Stopwatch;
use crate::error::{Error, Result};
use crate::io::Splat;
use crate::metrics::{CaptureScores, ContactSheet, Scores, score_views};
use crate::scene::{Gaussians, LocalFrame, RawGaussians};
use crate::stereo::DepthMap;
use std::path::PathBuf;
use std::time::Instant;
use tch::Tensor;

/// Number of steps between metrics.
const METRICS_EVERY: u64 = 50;
/// Fractions of the optimization at which the held-out views are scored, besides its start and its end.
const EVAL_FRACTIONS: [f64; 11] = [0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9];
/// Maximum number of views in a sample.
const MAX_SAMPLE: usize = 8;
/// Maximum number of pixels of the held-out views in a sample, if there are more than two.
const MAX_SAMPLE_PIXELS: u64 = 1_200_000;

/// Result of a session.
#[derive(Debug)]
pub struct RefineResult {
    /// Splat in the capture's world. If it is a splat that the session started from, it is unchanged.
    pub splat: Splat,
    /// Initial Gaussians in the session's frame, on its device.
    pub initial: Gaussians,
    /// Final Gaussians in the session's frame, on its device: the initial ones if they match the photos better than the optimized ones.
    pub gaussians: Gaussians,
    /// Learned correction of each photo, if corrections were requested.
    pub corrections: Vec<Correction>,
    /// Number of steps done.
    pub steps: u64,
    /// End of the optimization on the session's clock, in seconds.
    pub seconds: f64,
    /// State from which [`SceneInit::State`] continues; `None` if the final Gaussians are the initial ones.
    pub state: Option<RefineState>,
    /// Number of photos that the splat was matched to.
    pub photos: usize,
    /// Scores of a sample of the photos before and after the optimization.
    pub shown: [Scores; 2],
    /// Scores of a sample of the held-out views during the optimization. The last is that of the result.
    pub curve: Vec<EvalPoint>,
}

/// Refinement session: the photos and the state computed from them, in the local frame of the capture's cameras. Call
/// [`RefineSession::load`], then [`RefineSession::run`].
///
/// ```no_run
/// use globalsplat::data::{Holdout, open_capture};
/// use globalsplat::io::write_splat;
/// use globalsplat::refine::{RefineEvent, RefineOptions, RefineSession, SceneInit};
///
/// # fn main() -> globalsplat::Result<()> {
/// let capture = open_capture("captures/room".as_ref())?;
/// let holdout = Holdout::Every { every: 8, first: 0 };
/// let options = RefineOptions { seconds: 30., holdout, ..Default::default() };
/// let mut session = RefineSession::load(&capture, &options, SceneInit::Photos, |event| {
///     match event {
///         RefineEvent::Warning(line) => eprintln!("{line}"),
///         RefineEvent::Optimizing { steps, .. } => println!("{steps} steps"),
///         _ => {}
///     }
///     // `false` would end the work early.
///     true
/// })?;
/// let result = session.run()?;
/// write_splat("room.ply".as_ref(), &result.splat)?;
/// if let Some([before, after]) = session.score_held_out(&result)? {
///     println!("held-out views: {:.2} dB before, {:.2} dB after", before.mean.psnr, after.mean.psnr);
/// }
/// # Ok(())
/// # }
/// ```
pub struct RefineSession<'a> {
    capture: &'a Capture,
    options: &'a RefineOptions,
    init: SceneInit<'a>,
    /// Hyperparameters of the options. `antialiased` is also set for an initial splat or state that is antialiased.
    config: RefineConfig,
    /// Final number of Gaussians. A session that is ended early may have fewer.
    pub(crate) gaussians: usize,
    /// Size that the photos were loaded at.
    pub(crate) size: PhotoSize,
    time: TimeBudget,
    on_event: Box<dyn FnMut(RefineEvent) -> bool + 'a>,
    is_stopped: bool,
    frame: LocalFrame,
    photos: Vec<View>,
    held_out: Vec<View>,
    /// Depths of some photos, if Gaussians were created from them.
    depth_maps: Vec<DepthMap>,
    /// Initial exposures of the photos, if they are corrected.
    log_exposures: Option<Vec<LogGains>>,
    steps: u64,
    curve: Vec<EvalPoint>,
}

impl<'a> RefineSession<'a> {
    /// Chooses the photos and the held-out views of the capture, and reads them. The optimization will begin with `init`. `on_event` receives
    /// progress events and ends the work if it returns `false`.
    ///
    /// # Errors
    /// Fails if an option is out of range, if a photo can't be read or has fewer than [`MIN_SIDE`](crate::data::MIN_SIDE) pixels along a
    /// side, and if `on_event` ends the work before all photos are read.
    pub fn load(
        capture: &'a Capture,
        options: &'a RefineOptions,
        init: SceneInit<'a>,
        mut on_event: impl FnMut(RefineEvent) -> bool + 'a,
    ) -> Result<Self> {
        let clock = options.started.unwrap_or_else(Instant::now);
        options.check()?;
        let config = options.config(init.is_splat())?;
        let (gaussians, size) = init.sizes(capture, options);
        let ([shown, held_out], warning) = options.select_views(capture, size);
        if let Some(line) = warning {
            on_event(RefineEvent::Warning(&line));
        }
        let count = shown.len() + held_out.len();
        let mut should_continue = |done: usize| on_event(RefineEvent::Loading { done, count });
        let mut photos = load_photos(capture, &shown, size, &mut should_continue)?;
        let mut held_out =
            load_photos(capture, &held_out, size, |done| should_continue(photos.len() + done))?;
        let masked_out: Vec<String> = [&mut photos, &mut held_out]
            .into_iter()
            .flat_map(|views| views.extract_if(.., |view| view.is_masked_out()))
            .map(|view| view.name)
            .collect();
        if photos.is_empty() {
            let expected = "some in every photo";
            return Err(Error::input(capture.file(), "the masks", "no pixel that counts", expected));
        }
        if !masked_out.is_empty() {
            let names = summarize_names(&masked_out);
            let line = format!("{}: masked out as a whole, and left out: {names}", capture.name);
            on_event(RefineEvent::Warning(&line));
        }
        let frame = LocalFrame::from_cameras(&capture.cameras());
        for view in photos.iter_mut().chain(&mut held_out) {
            view.camera = frame.camera_to_local(&view.camera);
        }
        Ok(RefineSession {
            capture,
            options,
            init,
            config,
            gaussians,
            size,
            time: TimeBudget::new(options.budget(), clock),
            on_event: Box::new(on_event),
            is_stopped: false,
            frame,
            photos,
            held_out,
            depth_maps: vec![],
            log_exposures: None,
            steps: 0,
            curve: vec![],
        })
    }

    /// Creates the initial Gaussians, optimizes them, and scores a sample of the photos before and after. Near duplicates are left out of
    /// the photos.
    ///
    /// # Errors
    /// Fails if the model or the rasterizer fails, if no camera sees the splat, or if `on_event` ends the work before there are Gaussians.
    pub fn run(&mut self) -> Result<RefineResult> {
        let mut optimizer = self.initialize()?;
        let initial = optimizer.averaged_gaussians();
        let mut photo_opt = self.photo_opt(optimizer.depth)?;
        let begun_scoring = Instant::now();
        let before = self.score_photos(&initial, &photo_opt)?;
        self.time.reserve(optimizer.count().max(self.gaussians as i64), begun_scoring.elapsed());
        self.add_eval_point(&initial)?;
        if let Some(line) = self.time.late_start_warning() {
            self.warn(&line);
        }
        let (optimized, state) = self.optimize(&mut optimizer, &mut photo_opt)?;
        let seconds = self.time.elapsed().as_secs_f64();
        let after = self.score_photos(&optimized, &photo_opt)?;
        let is_worse = after.psnr.is_nan() || after.psnr < before.psnr;
        if is_worse && self.steps > 0 {
            self.warn("the initial splat reproduces the photos better: it is kept");
        }
        let gaussians = if is_worse { initial.map(Tensor::shallow_clone) } else { optimized };
        let splat = match self.init {
            SceneInit::Splat(splat) if is_worse => Splat { warnings: vec![], ..splat.clone() },
            _ => gaussians.to_world_units(&self.frame).to_splat(self.frame.origin)?,
        };
        self.add_eval_point(&gaussians)?;
        Ok(RefineResult {
            splat,
            initial,
            gaussians,
            state: Some(state).filter(|_| !is_worse),
            corrections: if is_worse { vec![] } else { photo_opt.report(&self.photos) },
            steps: self.steps,
            seconds,
            photos: self.photos.len(),
            shown: [before, if is_worse { before } else { after }],
            curve: std::mem::take(&mut self.curve),
        })
    }

    /// Scores a result on all held-out views, before and after the optimization. Returns `None` if no views are held out, or if `on_event`
    /// ends the scoring.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn score_held_out(&mut self, result: &RefineResult) -> Result<Option<[CaptureScores; 2]>> {
        let mut score = |gaussians: &Gaussians| -> Result<Option<CaptureScores>> {
            let should_continue = |done| (self.on_event)(RefineEvent::Scoring(done));
            let name = &self.capture.name;
            let scores = score_views(name, gaussians, &self.held_out, None, should_continue)?;
            Ok(scores.filter(|scores| scores.views.len() == self.held_out.len()))
        };
        Ok(score(&result.initial)?.zip(score(&result.gaussians)?).map(<[CaptureScores; 2]>::from))
    }

    /// Renders the held-out views, or else the photos, beside their photos: a row per view.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn contact_sheet(&self, result: &RefineResult) -> Result<ContactSheet> {
        let views = if self.held_out.is_empty() { &self.photos } else { &self.held_out };
        ContactSheet::render(&result.gaussians, views)
    }

    /// Creates the optimizer of the initial Gaussians, or of those of a state.
    fn initialize(&mut self) -> Result<GaussianOptimizer> {
        let RefineOptions { correct_exposures, device, .. } = *self.options;
        let final_count = if self.init.is_splat() { 0 } else { self.gaussians as i64 };
        let count = self.options.initial_gaussians(self.gaussians, &self.config);
        let mut antialiased = self.config.antialiased;
        let raw = match self.init {
            SceneInit::Splat(splat) => {
                antialiased = splat.antialiased;
                let local = Gaussians::from_splat(splat).to_local(&self.frame, splat.origin);
                RawGaussians::from_gaussians(&local.to_device(device))
            }
            SceneInit::State(state) => {
                self.config.antialiased |= state.record.antialiased;
                if state.record.has_depths {
                    self.gaussians_from_photos(count)?;
                }
                self.leave_out_near_duplicates(state.record.depth);
                self.check_state(state)?;
                let has_exposures = match correct_exposures {
                    ExposureCorrection::Off => false,
                    ExposureCorrection::Auto => state.has_exposures(),
                    ExposureCorrection::On => true,
                };
                self.log_exposures = has_exposures.then(|| vec![[0.; 3]; self.photos.len()]);
                return GaussianOptimizer::from_state(state, &self.config, final_count, device);
            }
            SceneInit::Photos => {
                if self.photos.len() < 2 {
                    let why = "one photo gives no depth: expected two or more, or an initial splat";
                    return Err(Error::request(why));
                }
                let center = |view: &View| view.camera.c2w.w_axis;
                if self.photos.iter().all(|view| center(view) == center(&self.photos[0])) {
                    let line = "the photos were all taken from one position, so that depth can't be estimated: everything is placed at one distance";
                    self.warn(&format!("{}: {line}", self.capture.name));
                }
                self.gaussians_from_photos(count)?
            }
        };
        self.config.antialiased |= antialiased;
        let depth = scene_depth(&Gaussians { antialiased, ..raw.activate() }, &self.photos)?;
        self.leave_out_near_duplicates(depth);
        if correct_exposures == ExposureCorrection::On && self.log_exposures.is_none() {
            self.log_exposures = Some(vec![[0.; 3]; self.photos.len()]);
        }
        Ok(GaussianOptimizer::new(&raw, depth, &self.config, final_count))
    }

    /// Creates `count` Gaussians on the session's device.
    fn gaussians_from_photos(&mut self, count: usize) -> Result<RawGaussians> {
        let to_local = |point: Point| Point { position: self.frame.point_to_local(point.position), ..point };
        let points: Vec<Point> = read_points(self.capture)?.into_iter().map(to_local).collect();
        let should_continue = |done: usize| {
            self.is_stopped |= !(self.on_event)(RefineEvent::Starting(done));
            !self.is_stopped
        };
        let RefineOptions { seed, correct_exposures: correction, .. } = *self.options;
        let init = gaussians_from_photos(&self.photos, &points, count, seed, correction, should_continue);
        let stopped = || Error::failed("stopped before there was a splat: nothing is written");
        let PhotoInit { gaussians, depth_maps, log_exposures } = init.ok_or_else(stopped)?;
        if let (Some(gains), ExposureCorrection::Auto) = (&log_exposures, correction) {
            let factors = gains.as_flattened().iter().map(|gain| gain.exp());
            let [min, max] = [factors.clone().fold(f64::MAX, f64::min), factors.fold(0., f64::max)];
            let line = "the exposures of neighboring photos differ, and all are corrected";
            self.warn(&format!("{}: {line}: {min:.2} to {max:.2} times the average", self.capture.name));
        }
        self.depth_maps = depth_maps;
        self.log_exposures = log_exposures;
        Ok(gaussians.to_device(self.options.device))
    }

    /// Removes near duplicates from the photos of a scene at `depth`, and names them.
    fn leave_out_near_duplicates(&mut self, depth: f64) {
        let all = self.photos.len();
        let is_kept = distinct(&self.photos, depth);
        let mut kept = is_kept.iter();
        let left_out: Vec<String> = self
            .photos
            .extract_if(.., |_| !kept.next().expect("one for each photo"))
            .map(|photo| photo.name)
            .collect();
        if let Some(exposures) = &mut self.log_exposures {
            let mut kept = is_kept.iter();
            exposures.retain(|_| *kept.next().expect("one for each photo"));
        }
        if !left_out.is_empty() {
            let (name, count, names) = (&self.capture.name, left_out.len(), summarize_names(&left_out));
            let line = "photos are nearly equal to others, and left out";
            self.warn(&format!("{name}: {count} of {all} {line}: {names}"));
        }
    }

    /// Returns the corrections with which the optimization begins, those of a state if it continues from one.
    fn photo_opt(&self, depth: f64) -> Result<PhotoOpt> {
        let (RefineOptions { correct_poses, device, .. }, config) = (self.options, &self.config);
        let lr_poses = config.lr_poses_for(longest_side(&self.photos));
        let config = RefineConfig { lr_poses, ..config.clone() };
        let (count, exposures) = (self.photos.len(), self.log_exposures.as_deref());
        let mut photo_opt = PhotoOpt::new(count, *correct_poses, exposures, depth, &config, *device);
        if let SceneInit::State(state) = self.init {
            photo_opt.load_state(state)?;
        }
        Ok(photo_opt)
    }

    /// Optimizes the Gaussians of `optimizer` and the corrections of the photos. Returns the Gaussians and the state.
    fn optimize(
        &mut self,
        optimizer: &mut GaussianOptimizer,
        photo_opt: &mut PhotoOpt,
    ) -> Result<(Gaussians, RefineState)> {
        let (progress, earlier_total) = match self.init {
            SceneInit::State(state) => (state.record.progress, state.record.total),
            _ => Default::default(),
        };
        let budget = match self.is_stopped {
            true => Budget::Steps(0),
            false => self.time.remaining(progress.time, earlier_total),
        };
        let (config, photo_names) = (self.config.clone(), self.photo_names());
        let args = OptimizeArgs {
            photos: &Photos::new(&self.photos, &self.depth_maps, &config, self.options.device),
            config: &config,
            budget,
            seed: self.options.seed,
            background: self.options.mask_background,
            progress,
        };
        let mut fractions = EVAL_FRACTIONS.iter().peekable();
        let (mut is_due, mut failure) = (false, None);
        let progress = refine(optimizer, photo_opt, &args, &mut Stopwatch::default(), |now| {
            self.steps = now.step;
            while fractions.next_if(|&&fraction| now.progress >= fraction).is_some() {
                is_due = true;
            }
            if is_due && self.time.may_score() {
                is_due = false;
                failure = self.add_eval_point(&now.optimizer.averaged_gaussians()).err();
            }
            if now.step.is_multiple_of(METRICS_EVERY) {
                let metrics = RefineEvent::Measured {
                    steps: now.step,
                    seconds: self.time.elapsed().as_secs_f64(),
                    loss: now.loss.double_value(&[]),
                    gaussians: now.optimizer.count(),
                    learning_rate: now.optimizer.means_learning_rate(now.progress),
                };
                self.is_stopped |= !(self.on_event)(metrics);
            }
            let psnr = self.curve.last().map(|point| point.scores.psnr);
            self.is_stopped |= !(self.on_event)(RefineEvent::Optimizing { steps: self.steps, psnr });
            failure.is_none() && !self.is_stopped
        })?;
        if let Some(error) = failure {
            return Err(error);
        }
        let record = Record {
            photos: photo_names,
            frame: self.frame_numbers(),
            progress,
            total: earlier_total + self.time.elapsed(),
            depth: optimizer.depth,
            has_depths: !self.depth_maps.is_empty(),
            antialiased: config.antialiased,
            from_splat: self.init.is_splat(),
            growth: optimizer.growth,
        };
        let (gaussians, corrections) = (optimizer.state(), photo_opt.state());
        let state = RefineState { record, gaussians, corrections, file: PathBuf::new() };
        Ok((optimizer.averaged_gaussians(), state))
    }

    /// Returns an error if `state` is that of other photos or cameras, or if the budget has been used up already.
    fn check_state(&self, state: &RefineState) -> Result<()> {
        let Record { photos, frame, progress, total, .. } = &state.record;
        if *frame != self.frame_numbers() || *photos != self.photo_names() {
            let found = format!("that of another refinement, {} photos", photos.len());
            let expected =
                format!("that of the {} photos of this one, with the same poses", self.photos.len());
            return Err(Error::input(&state.file, "the list of photos", found, expected));
        }
        let (used, expected) = match self.options.budget() {
            Budget::Steps(steps) if steps <= progress.steps => {
                (format!("{} steps", progress.steps), "more steps in all")
            }
            Budget::Time(time) if time <= *total => {
                (format!("{:.0} s", total.as_secs_f64()), "more time in all")
            }
            _ => return Ok(()),
        };
        Err(Error::input(&state.file, "the refinement", format!("one of {used} already"), expected))
    }

    fn photo_names(&self) -> Vec<String> {
        self.photos.iter().map(|photo| photo.name.clone()).collect()
    }

    /// Returns the origin and the scale of the frame.
    fn frame_numbers(&self) -> [f64; 4] {
        let [x, y, z] = self.frame.origin.to_array();
        [x, y, z, self.frame.scale]
    }

    /// Scores Gaussians on a sample of the photos, to which corrections are applied.
    fn score_photos(&self, gaussians: &Gaussians, photo_opt: &PhotoOpt) -> Result<Scores> {
        let views: Vec<View> =
            sample(&self.photos, MAX_SAMPLE).map(|(index, view)| photo_opt.apply(index, view)).collect();
        Ok(score_views("sample", gaussians, &views, None, |_| true)?.expect("at least one photo").mean)
    }

    /// Scores a sample of the held-out views, if there are any, and appends the scores to the curve.
    fn add_eval_point(&mut self, gaussians: &Gaussians) -> Result<()> {
        let begun = Instant::now();
        let pixels = |view: &View| u64::from(view.camera.width) * u64::from(view.camera.height);
        let largest = self.held_out.iter().map(pixels).max().unwrap_or(1);
        let count = ((MAX_SAMPLE_PIXELS / largest) as usize).clamp(2, MAX_SAMPLE);
        let views: Vec<View> = sample(&self.held_out, count).map(|(_, view)| view.shallow_clone()).collect();
        if let Some(scores) = score_views("sample", gaussians, &views, None, |_| true)? {
            let seconds = self.time.elapsed().as_secs_f64();
            let point = EvalPoint { seconds, steps: self.steps, scores: scores.mean };
            self.is_stopped |= !(self.on_event)(RefineEvent::Scored(&point));
            self.curve.push(point);
        }
        self.time.add_scoring(begun.elapsed());
        Ok(())
    }

    fn warn(&mut self, line: &str) {
        self.is_stopped |= !(self.on_event)(RefineEvent::Warning(line));
    }
}

/// Returns at most `count` evenly spread views of all, with their indices. They are scored as a whole: a part of an image has other borders,
/// near which large Gaussians are projected differently.
fn sample(views: &[View], count: usize) -> impl Iterator<Item = (usize, &View)> {
    views.iter().enumerate().step_by(views.len().div_ceil(count).max(1))
}

/// Returns the first few names, and the number of the others.
fn summarize_names(all: &[String]) -> String {
    const FEW: usize = 3;
    let few = all[..all.len().min(FEW)].join(", ");
    if all.len() > FEW { format!("{few} and {} more", all.len() - FEW) } else { few }
}
