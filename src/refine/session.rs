//! Refinement session from a capture to Gaussians: reads the photos, creates the initial Gaussians, optimizes them, and scores them on a
//! few views during the optimization. All of it shares one budget and uses a local frame of the capture (spec 2.5).

use super::config::RefineConfig;
use super::corrections::{Correction, Corrections};
use super::events::{EvalPoint, RefineEvent, RefineMetrics, ViewSample, summarize_names};
use super::exposures::LogGains;
use super::gaussian_optimizer::GaussianOptimizer;
use super::init::{PhotoInit, SceneInit, gaussians_from_photos, most_visible};
use super::options::{Budget, ExposureCorrection, RefineOptions, TimeBudget};
use super::photos::{Photos, distinct, load_photos};
use super::state::{Record, RefineState};
use super::{OptimizeArgs, refine, scene_depth};
use crate::data::{Capture, PhotoSize, Point, View, read_points};
use crate::error::{Error, Result};
use crate::io::Splat;
use crate::metrics::{CaptureScores, ContactSheet, Perceptual, Scores, score_views};
use crate::reconstruct::{LoadedModel, Model, reconstruct, spread_over_path};
use crate::scene::{Camera, Gaussians, LocalFrame, RawGaussians};
use crate::stereo::DepthMap;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};
use tch::Tensor;

/// Divisor of the maximum number of initial Gaussians of a model: 1/`MODEL_SHARE` of all.
const MODEL_SHARE: usize = 3;
/// Number of steps between metrics.
const METRICS_EVERY: u64 = 50;
/// Maximum number of photos that LPIPS compares if no views are held out.
const LPIPS_PHOTOS: usize = 8;
/// Fractions of the optimization at which the held-out views are scored.
const EVAL_FRACTIONS: [f64; 12] = [0., 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9];

/// Result of a session.
#[derive(Debug)]
pub struct RefineResult {
    /// Splat in the capture's world. If it is a splat that the session started from, it is unchanged.
    pub splat: Splat,
    /// Initial Gaussians in the session's frame, on its device.
    pub initial: Gaussians,
    /// Final Gaussians in the session's frame, on its device.
    pub gaussians: Gaussians,
    /// `true` if these are the initial Gaussians, which matched the photos better than the optimized ones.
    pub is_initial: bool,
    /// Learned correction of each photo, if corrections were requested.
    pub corrections: Vec<Correction>,
    /// Number of steps done.
    pub steps: u64,
    /// Start and end of the optimization on the session's clock, in seconds.
    pub seconds: [f64; 2],
    /// State from which [`SceneInit::State`] continues; `None` if the final Gaussians are the initial ones.
    pub state: Option<RefineState>,
    /// Scores of a sample of the photos before and after the optimization.
    pub shown: [Scores; 2],
    /// Number of photos in this sample.
    pub shown_photos: usize,
    /// Scores of a sample of the held-out views during the optimization.
    pub curve: Vec<EvalPoint>,
    /// Scores of the initial Gaussians on whole held-out views; `None` if there are none, or if the callback ended the scoring.
    /// [`RefineSession::score_held_out`] also scores the final Gaussians.
    pub held_out_before: Option<CaptureScores>,
}

/// Initial Gaussians of a session.
struct Start {
    gaussians: Gaussians,
    /// Median depth of these Gaussians.
    depth: f64,
    /// Their optimizer; `None` if it begins with other Gaussians than a model's alone.
    optimizer: Option<GaussianOptimizer>,
}

/// Refinement session: the photos and the state computed from them, in the local frame of the capture's cameras. Call
/// [`RefineSession::load`], then [`RefineSession::start`], then [`RefineSession::run`].
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
/// session.start()?;
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
    gaussians: usize,
    size: PhotoSize,
    time: TimeBudget,
    on_event: Box<dyn FnMut(RefineEvent) -> bool + 'a>,
    is_stopped: bool,
    frame: LocalFrame,
    photos: Vec<View>,
    held_out: Vec<View>,
    /// Views among `scored` that are scored during the optimization.
    held_out_sample: ViewSample,
    /// Held-out views that there is time to score as a whole.
    scored: Vec<View>,
    start: Option<Start>,
    near_duplicates: usize,
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
    /// Fails if an option is out of range, like [`load_photos`], and if `on_event` ends the work before all photos are read.
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
            let _ = on_event(RefineEvent::Warning(&line));
        }
        let count = shown.len() + held_out.len();
        let mut should_continue = |done: usize| on_event(RefineEvent::Loading { done, count });
        let mut photos = load_photos(capture, &shown, size, &mut should_continue)?;
        let mut held_out =
            load_photos(capture, &held_out, size, |done| should_continue(photos.len() + done))?;
        let frame = LocalFrame::from_cameras(&capture.cameras());
        let masked_out = [&mut photos, &mut held_out].map(|views| {
            let masked_out = views.extract_if(.., |view| view.is_masked_out());
            masked_out.map(|view| view.name).collect::<Vec<String>>()
        });
        let masked_out = masked_out.concat();
        if photos.is_empty() {
            return Err(Error::input(
                capture.file(),
                "the masks",
                "no pixel that counts",
                "some in every photo",
            ));
        }
        if !masked_out.is_empty() {
            let line = format!(
                "{}: masked out as a whole, and left out: {}",
                capture.name,
                summarize_names(&masked_out)
            );
            on_event(RefineEvent::Warning(&line));
        }
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
            held_out_sample: ViewSample::small(&[]),
            photos,
            held_out,
            scored: vec![],
            start: None,
            near_duplicates: 0,
            depth_maps: vec![],
            log_exposures: None,
            steps: 0,
            curve: vec![],
        })
    }

    /// Returns the number of Gaussians that the optimization ends with if it isn't ended early.
    pub fn gaussians(&self) -> usize {
        self.gaussians
    }

    /// Returns the size that the photos were loaded at.
    pub fn size(&self) -> PhotoSize {
        self.size
    }

    /// Returns the photos that the splat has to match, in the session's frame. After [`RefineSession::start`], near duplicates are removed.
    pub fn photos(&self) -> &[View] {
        &self.photos
    }

    /// Returns the held-out views, in the session's frame.
    pub fn held_out(&self) -> &[View] {
        &self.held_out
    }

    /// Returns the views that represent the splat's quality, in the session's frame: the held-out views if there are any, else the photos.
    fn representative_views(&self) -> &[View] {
        if self.held_out.is_empty() { &self.photos } else { &self.held_out }
    }

    /// Returns the number of photos that were left out as near duplicates.
    pub fn near_duplicates(&self) -> usize {
        self.near_duplicates
    }

    /// Reserves a further part of the time budget for work after the optimization. Writing the splat and scoring the held-out views are
    /// provided for already.
    pub fn reserve(&mut self, time: Duration) {
        self.time.reserve += time;
    }

    /// Reserves the time of [`RefineSession::contact_sheet`], estimated by rendering one row of `gaussians`.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn reserve_for_contact_sheet(&mut self, gaussians: &Gaussians) -> Result<()> {
        let views = self.representative_views();
        let begun = Instant::now();
        let _ = ContactSheet::render(gaussians, &views[..1])?;
        let time = begun.elapsed() * views.len() as u32;
        self.reserve(time);
        Ok(())
    }

    /// Creates the initial Gaussians, and returns them in the session's frame on its device. Near duplicates are removed from the photos.
    ///
    /// # Errors
    /// Fails if the model or the rasterizer fails, if no camera sees the splat, or if `on_event` ends the work before there are Gaussians.
    pub fn start(&mut self) -> Result<Gaussians> {
        let mut warnings = vec![];
        let RefineOptions { correct_exposures, device, .. } = *self.options;
        let final_count = if self.init.is_splat() { 0 } else { self.gaussians as i64 };
        // Gaussians of a new optimizer, or the optimizer of a state.
        let (mut raw, mut optimizer) = (None, None);
        let gaussians = match self.init {
            SceneInit::Splat(splat) => {
                self.config.antialiased |= splat.antialiased;
                let local = Gaussians::from_splat(splat).to_local(&self.frame, splat.origin);
                let local = raw.insert(RawGaussians::from_gaussians(&local.to_device(device)));
                Gaussians { antialiased: splat.antialiased, ..local.activate() }
            }
            SceneInit::State(state) => {
                self.config.antialiased |= state.record.antialiased;
                if state.record.has_depths {
                    let _ = self.gaussians_from_photos(self.initial_count())?.ok_or_else(stopped)?;
                }
                if correct_exposures == ExposureCorrection::Auto {
                    self.log_exposures = state.has_exposures().then(|| self.equal_exposures());
                }
                let known = GaussianOptimizer::from_state(state, &self.config, final_count, device)?;
                optimizer.insert(known).averaged_gaussians()
            }
            SceneInit::Model(loaded) => self.reconstruct(loaded)?,
            SceneInit::Photos => {
                if self.photos.len() < 2 {
                    let why = "one photo gives no depth: expected two or more, or an initial splat";
                    return Err(Error::request(why));
                }
                if self.are_in_one_place() {
                    let line = "the photos were all taken from one position, so that depth can't be estimated: everything is placed at one distance";
                    warnings.push(format!("{}: {line}", self.capture.name));
                }
                let new = self.gaussians_from_photos(self.initial_count())?.ok_or_else(stopped)?;
                warnings.extend(self.exposure_warning());
                Gaussians { antialiased: self.config.antialiased, ..raw.insert(new).activate() }
            }
        };
        if correct_exposures == ExposureCorrection::On && self.log_exposures.is_none() {
            self.log_exposures = Some(self.equal_exposures());
        }
        let depth = match self.init {
            SceneInit::State(state) => state.record.depth,
            _ => scene_depth(&gaussians, &self.photos)?,
        };
        warnings.extend(self.leave_out_near_duplicates(depth));
        if let SceneInit::State(state) = self.init {
            self.check_state(state)?;
        }
        warnings.iter().for_each(|line| self.warn(line));
        let new = || Some(GaussianOptimizer::new(raw.as_ref()?, depth, &self.config, final_count));
        let optimizer = optimizer.or_else(new);
        self.start = Some(Start { gaussians: gaussians.map(Tensor::shallow_clone), depth, optimizer });
        Ok(gaussians)
    }

    /// Returns the reconstruction of the photos by a model.
    fn reconstruct(&self, loaded: &LoadedModel) -> Result<Gaussians> {
        let data = &loaded.config.data;
        let all: Vec<usize> = (0..self.photos.len()).collect();
        let count = self.options.views.unwrap_or(data.context_views);
        let context = spread_over_path(&self.cameras(), &all, count)
            .into_iter()
            .map(|index| self.photos[index].fitted(data.image_size))
            .collect::<Result<Vec<_>>>()?;
        // The optimization fits the colors, too.
        let mut config = loaded.config.clone();
        config.data.color_steps = 0;
        let model = Model { config: &config, ..loaded.into() };
        Ok(reconstruct(model, &context, &[])?.in_world().to_device(self.options.device))
    }

    /// Returns the number of Gaussians to create from photos.
    fn initial_count(&self) -> usize {
        self.options.initial_gaussians(self.gaussians, &self.config)
    }

    /// Scores the result of [`RefineSession::start`] on the held-out views, optimizes it, and scores a sample of the photos before and
    /// after.
    ///
    /// # Errors
    /// Fails if rendering fails.
    ///
    /// # Panics
    /// Panics if [`RefineSession::start`] was not called before.
    pub fn run(&mut self) -> Result<RefineResult> {
        let Start { gaussians: initial, depth, optimizer } =
            self.start.take().expect("a session that was started");
        self.scored = self.affordable_views(&initial)?;
        self.held_out_sample = ViewSample::small(&self.scored);
        let scoring = Instant::now();
        let held_out_before = self.score_whole(&initial, &self.scored_views(), None)?;
        self.reserve(scoring.elapsed());
        self.time.reserve_for_writing(initial.count().max(self.gaussians as i64));
        let begun_scoring = Instant::now();
        let sample = ViewSample::large(&self.photos);
        let before = sample.corrected(&self.corrections(depth)?).score(&initial)?.expect("photos");
        let time = begun_scoring.elapsed();
        self.reserve(time);
        self.time.last_scoring = time.mul_f64(self.held_out_sample.len() as f64 / sample.len() as f64);
        if let Some(line) = self.time.late_start_warning() {
            self.warn(&line);
        }
        if matches!(self.init, SceneInit::Model(_)) {
            self.add_eval_point(&initial)?;
        }
        let begun = self.time.seconds();
        let (gaussians, learned, state) = if self.is_stopped {
            (initial.map(Tensor::shallow_clone), Corrections::none(), None)
        } else {
            let (gaussians, learned, state) = self.optimize(&initial, optimizer, depth)?;
            (gaussians, learned, Some(state))
        };
        let ended = self.time.seconds();
        let after = sample.corrected(&learned).score(&gaussians)?.expect("photos");
        let is_initial = after.psnr.is_nan() || after.psnr < before.psnr;
        let corrections =
            if learned.has_any() && !is_initial { learned.report(&self.photos) } else { vec![] };
        let gaussians = if is_initial { initial.map(Tensor::shallow_clone) } else { gaussians };
        let splat = match self.init {
            SceneInit::Splat(splat) if is_initial => Splat { warnings: vec![], ..splat.clone() },
            _ => gaussians.to_world_units(&self.frame).to_splat(self.frame.origin)?,
        };
        Ok(RefineResult {
            splat,
            initial,
            gaussians,
            is_initial,
            state: state.filter(|_| !is_initial),
            corrections,
            steps: self.steps,
            seconds: [begun, ended],
            shown_photos: sample.len(),
            shown: if is_initial { [before; 2] } else { [before, after] },
            curve: std::mem::take(&mut self.curve),
            held_out_before,
        })
    }

    /// Scores a result on whole held-out views: those that [`RefineSession::run`] scored before the optimization. With a time budget there
    /// may be fewer than all. Returns the scores before and after the optimization; `None` if no views are held out, or if `on_event` ended
    /// the scoring.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn score_held_out(&mut self, result: &RefineResult) -> Result<Option<[CaptureScores; 2]>> {
        let before = result.held_out_before.clone();
        let after = if result.is_initial {
            before.clone()
        } else {
            self.score_whole(&result.gaussians, &self.scored_views(), None)?
        };
        Ok(before.zip(after).map(<[CaptureScores; 2]>::from))
    }

    /// Returns the mean scores of the sample of [`EvalPoint`], given the scores of all views by [`RefineSession::score_held_out`].
    pub fn sample_scores(&self, scores: &CaptureScores) -> Scores {
        self.held_out_sample.select_scores(scores)
    }

    /// Scores the initial and the final Gaussians by LPIPS, with the networks whose weights are installed: on all held-out views, or on a
    /// few photos if no views are held out. Returns `None` if `on_event` ends the scoring.
    ///
    /// # Errors
    /// Fails if rendering fails, or if a file of weights is invalid.
    pub fn score_lpips(&mut self, result: &RefineResult) -> Result<Option<[CaptureScores; 2]>> {
        let perceptual = Perceptual::new(result.initial.means.device());
        let count = if self.held_out.is_empty() { LPIPS_PHOTOS } else { self.held_out.len() };
        let views: Vec<View> =
            self.representative_views().iter().take(count).map(View::shallow_clone).collect();
        let before = self.score_whole(&result.initial, &views, Some(&perceptual))?;
        let after = self.score_whole(&result.gaussians, &views, Some(&perceptual))?;
        if let Some(line) = after.as_ref().and_then(|after| Perceptual::explain_missing(&after.mean)) {
            self.warn(&line);
        }
        Ok(before.zip(after).map(<[CaptureScores; 2]>::from))
    }

    /// Renders the held-out views, or else the photos, beside their photos: a row per view.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn contact_sheet(&self, result: &RefineResult) -> Result<ContactSheet> {
        ContactSheet::render(&result.gaussians, self.representative_views())
    }

    /// Returns an evenly spaced subset of the held-out views that can be scored within a time budget.
    fn affordable_views(&mut self, gaussians: &Gaussians) -> Result<Vec<View>> {
        let every = match self.options.budget() {
            Budget::Time(_) if !self.held_out.is_empty() => {
                let begun = Instant::now();
                self.score_whole(gaussians, &[self.held_out[0].shallow_clone()], None)?;
                self.time.affordable_every(begun.elapsed() * self.held_out.len() as u32)
            }
            _ => 1,
        };
        Ok(self.held_out.iter().step_by(every).map(View::shallow_clone).collect())
    }

    fn scored_views(&self) -> Vec<View> {
        self.scored.iter().map(View::shallow_clone).collect()
    }

    /// Scores Gaussians on whole views. Returns `None` if there are no views, or if `on_event` ends the scoring.
    fn score_whole(
        &mut self,
        gaussians: &Gaussians,
        views: &[View],
        perceptual: Option<&Perceptual>,
    ) -> Result<Option<CaptureScores>> {
        let should_continue = |done| (self.on_event)(RefineEvent::Scoring(done));
        let scores = score_views(&self.capture.name, gaussians, views, perceptual, should_continue)?;
        Ok(scores.filter(|scores| scores.views.len() == views.len()))
    }

    fn warn(&mut self, line: &str) {
        let _ = (self.on_event)(RefineEvent::Warning(line));
    }

    fn cameras(&self) -> Vec<Camera> {
        self.photos.iter().map(|photo| photo.camera).collect()
    }

    fn photo_names(&self) -> Vec<String> {
        self.photos.iter().map(|photo| photo.name.clone()).collect()
    }

    /// Returns the origin and the scale of the frame.
    fn frame_numbers(&self) -> [f64; 4] {
        let [x, y, z] = self.frame.origin.to_array();
        [x, y, z, self.frame.scale]
    }

    fn are_in_one_place(&self) -> bool {
        let center = |view: &View| view.camera.c2w.w_axis;
        self.photos.iter().all(|view| center(view) == center(&self.photos[0]))
    }

    /// Removes near duplicates from the photos. Returns a warning that names them, if there are any.
    fn leave_out_near_duplicates(&mut self, depth: f64) -> Option<String> {
        let keep = distinct(&self.photos, depth);
        if keep.len() == self.photos.len() {
            return None;
        }
        let mut is_kept = vec![false; self.photos.len()];
        keep.iter().for_each(|&index| is_kept[index] = true);
        let mut left_out = vec![];
        let photos = std::mem::take(&mut self.photos);
        for (photo, is_kept) in photos.into_iter().zip(is_kept) {
            if is_kept { self.photos.push(photo) } else { left_out.push(photo.name) }
        }
        let kept = |all: Vec<LogGains>| keep.iter().map(|&index| all[index]).collect();
        self.log_exposures = self.log_exposures.take().map(kept);
        self.near_duplicates = left_out.len();
        let (count, all) = (left_out.len(), left_out.len() + self.photos.len());
        Some(format!(
            "{}: {count} of {all} photos are nearly equal to others, and left out: {}",
            self.capture.name,
            summarize_names(&left_out)
        ))
    }

    /// Creates `count` Gaussians on the session's device. Returns `None` if the work is ended before any photo has depths.
    fn gaussians_from_photos(&mut self, count: usize) -> Result<Option<RawGaussians>> {
        let to_local = |point: Point| Point { position: self.frame.point_to_local(point.position), ..point };
        let points: Vec<Point> = read_points(self.capture)?.into_iter().map(to_local).collect();
        let (time, on_event) = (&self.time, &mut self.on_event);
        let mut is_stopped = false;
        let should_continue = |done: usize| {
            is_stopped |= !on_event(RefineEvent::Starting(done));
            !is_stopped && !time.is_late_for_depths(done)
        };
        let RefineOptions { seed, correct_exposures: correction, .. } = *self.options;
        let init = gaussians_from_photos(&self.photos, &points, count, seed, correction, should_continue);
        self.is_stopped |= is_stopped;
        let Some(PhotoInit { gaussians, depth_maps, log_exposures }) = init else { return Ok(None) };
        self.depth_maps = depth_maps;
        self.log_exposures = log_exposures;
        Ok(Some(gaussians.to_device(self.options.device)))
    }

    /// Returns a line that says that exposures are corrected, if this was not requested.
    fn exposure_warning(&self) -> Option<String> {
        let gains = self.log_exposures.as_ref()?;
        let factors = gains.as_flattened().iter().map(|gain| gain.exp());
        let [min, max] = [factors.clone().fold(f64::MAX, f64::min), factors.fold(0., f64::max)];
        (self.options.correct_exposures == ExposureCorrection::Auto).then(|| {
            format!(
                "{}: the exposures of neighboring photos differ, and all are corrected: {min:.2} to {max:.2} times the average",
                self.capture.name
            )
        })
    }

    /// Returns the exposures of photos that don't differ.
    fn equal_exposures(&self) -> Vec<LogGains> {
        vec![[0.; 3]; self.photos.len()]
    }

    /// Returns the corrections with which the optimization begins, those of a state if it continues from one.
    fn corrections(&self, depth: f64) -> Result<Corrections> {
        let (RefineOptions { correct_poses, device, .. }, config) = (self.options, &self.config);
        let (count, exposures) = (self.photos.len(), self.log_exposures.as_deref());
        let sides = self.photos.iter().map(|photo| photo.camera.width.max(photo.camera.height));
        let lr_poses = config.lr_poses_for(sides.max().unwrap_or(0));
        let config = RefineConfig { lr_poses, ..config.clone() };
        let mut corrections = Corrections::new(count, *correct_poses, exposures, depth, &config, *device);
        if let SceneInit::State(state) = self.init {
            corrections.load_state(state)?;
        }
        Ok(corrections)
    }

    /// Optimizes the Gaussians of `optimizer`, or those of a model and others, and the corrections of the photos. `depth` is the depth of the
    /// `initial` Gaussians.
    fn optimize(
        &mut self,
        initial: &Gaussians,
        optimizer: Option<GaussianOptimizer>,
        mut depth: f64,
    ) -> Result<(Gaussians, Corrections, RefineState)> {
        let mut optimizer = match optimizer {
            Some(optimizer) => optimizer,
            None => {
                let raw = self.with_gaussians_from_photos(initial)?;
                depth = scene_depth(&raw.activate(), &self.photos)?;
                GaussianOptimizer::new(&raw, depth, &self.config, self.gaussians as i64)
            }
        };
        let (RefineOptions { seed, device, .. }, config) = (self.options, self.config.clone());
        let mut corrections = self.corrections(depth)?;
        let (progress, earlier_total) = match self.init {
            SceneInit::State(state) => (state.record.progress, state.record.total),
            _ => Default::default(),
        };
        let photos = Photos::new(&self.photos, &self.depth_maps, &config, *device);
        let budget = self.time.remaining(progress.time, earlier_total);
        let background = self.options.mask_background;
        let args = OptimizeArgs {
            photos: &photos,
            depth,
            config: &config,
            budget,
            seed: *seed,
            background,
            progress,
        };
        let mut fractions = EVAL_FRACTIONS.iter().peekable();
        let (mut is_due, mut failure) = (false, None);
        let (gaussians, progress) = refine(&mut optimizer, &mut corrections, &args, |now| {
            self.steps = now.step;
            while fractions.next_if(|&&fraction| now.progress >= fraction).is_some() {
                is_due = true;
            }
            if is_due && self.time.may_score() {
                is_due = false;
                failure = self.add_eval_point(&now.gaussians()).err();
            }
            if now.step.is_multiple_of(METRICS_EVERY) {
                let metrics = RefineMetrics {
                    step: now.step,
                    seconds: self.time.seconds(),
                    loss: now.loss(),
                    gaussians: now.count(),
                    learning_rate: now.means_learning_rate(),
                };
                self.is_stopped |= !(self.on_event)(RefineEvent::Measured(&metrics));
            }
            let psnr = self.curve.last().map(|point| point.scores.psnr);
            self.is_stopped |= !(self.on_event)(RefineEvent::Optimizing { steps: self.steps, psnr });
            failure.is_none() && !self.is_stopped
        })?;
        if let Some(error) = failure {
            return Err(error);
        }
        let mut tensors = BTreeMap::new();
        optimizer.add_to_state(&mut tensors);
        corrections.add_to_state(&mut tensors);
        let record = Record {
            photos: self.photo_names(),
            frame: self.frame_numbers(),
            progress,
            total: earlier_total + self.time.elapsed(),
            depth,
            has_depths: !self.depth_maps.is_empty(),
            antialiased: config.antialiased,
            from_splat: self.init.is_splat(),
            growth: optimizer.growth(),
        };
        Ok((gaussians, corrections, RefineState::new(record, tensors)))
    }

    /// Returns an error if `state` is that of other photos or cameras, or if the budget has been used up already.
    fn check_state(&self, state: &RefineState) -> Result<()> {
        let Record { photos, frame, progress, total, .. } = &state.record;
        if *frame != self.frame_numbers() || *photos != self.photo_names() {
            let found = format!("that of another refinement, {} photos", photos.len());
            let expected =
                format!("that of the {} photos of this one, with the same poses", self.photos.len());
            return Err(Error::input(state.file(), "the list of photos", found, expected));
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
        Err(Error::input(state.file(), "the refinement", format!("one of {used} already"), expected))
    }

    /// Returns the Gaussians of a model that the photos show best, and new ones at the depths on which the photos agree. As few as from photos
    /// alone are faster to optimize, and grow to the requested number.
    fn with_gaussians_from_photos(&mut self, gaussians: &Gaussians) -> Result<RawGaussians> {
        let mut raw = RawGaussians::from_gaussians(gaussians);
        if self.photos.len() < 2 {
            return Ok(raw);
        }
        // Higher spherical harmonics are added later, for all Gaussians at the same time.
        raw.sh = raw.sh.narrow(2, 0, 1);
        let count = self.initial_count();
        let of_model = count / MODEL_SHARE;
        let Some(new) = self.gaussians_from_photos(count - of_model)? else { return Ok(raw) };
        if let Some(line) = self.exposure_warning() {
            self.warn(&line);
        }
        Ok(most_visible(&raw, &self.depth_maps, of_model)?.to_device(self.options.device).concat(&new))
    }

    /// Scores the sample of the held-out views, if there are any, and appends the scores to the curve.
    fn add_eval_point(&mut self, gaussians: &Gaussians) -> Result<()> {
        let begun = Instant::now();
        if let Some(scores) = self.held_out_sample.score(gaussians)? {
            let point = EvalPoint { seconds: self.time.seconds(), steps: self.steps, scores };
            self.is_stopped |= !(self.on_event)(RefineEvent::Scored(&point));
            self.curve.push(point);
        }
        self.time.add_scoring(begun.elapsed());
        Ok(())
    }
}

/// Returns the error of a session that is ended before there is a result.
fn stopped() -> Error {
    Error::failed("stopped before there was a splat: nothing is written")
}
