//! Refinement session from a capture to Gaussians: reads the photos, creates the initial Gaussians, optimizes them, and scores them on a
//! few views during the optimization. All of it shares one budget and uses a local frame of the capture (spec 2.5).

use super::events::{EvalPoint, RefineEvent};
use super::exposures::LogGains;
use super::gaussian_optimizer::GaussianOptimizer;
use super::init::{PhotoInit, SceneInit, gaussians_from_photos, most_visible};
use super::options::{ExposureCorrection, RefineOptions};
use super::photo_opt::{Correction, PhotoOpt};
use super::photos::{Photos, distinct, load_photos, longest_side};
use super::state::{Record, RefineState};
use super::time_budget::TimeBudget;
use super::{OptimizeArgs, refine, scene_depth};
use crate::data::{Capture, PhotoSize, Point, View, read_points};
use crate::device::Stopwatch;
use crate::error::{Error, Result};
use crate::io::Splat;
use crate::metrics::{CaptureScores, ContactSheet, Perceptual, Scores, score_views};
use crate::quality::CaptureQuality;
use crate::reconstruct::{LoadedModel, Model, reconstruct, spread_over_path};
use crate::scene::{Camera, Gaussians, LocalFrame, RawGaussians};
use crate::stereo::DepthMap;
use globalsplat_capture::format_names;
use rayon::prelude::*;
use std::collections::HashMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use tch::Tensor;

/// Divisor of the maximum number of initial Gaussians of a model: 1/`MODEL_SHARE` of all.
const MODEL_SHARE: usize = 3;
/// Number of photos that a warning names.
const SHOWN_NAMES: usize = 3;
/// Number of steps between metrics.
const METRICS_EVERY: u64 = 50;
/// Maximum number of photos that LPIPS compares if no views are held out.
const LPIPS_PHOTOS: usize = 8;
/// Fractions of the optimization at which the held-out views are scored.
const EVAL_FRACTIONS: [f64; 12] = [0., 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9];
/// Maximum number of views in a sample.
const MAX_SAMPLE: usize = 8;
/// Maximum number of pixels of all views in a sample that is scored several times, if it has more than two.
const MAX_SAMPLE_PIXELS: u64 = 1_200_000;

/// Result of a session.
#[derive(Debug)]
pub struct RefineResult {
    /// Splat in the capture's world. An initial splat that matches the photos better than the optimized one is returned unchanged.
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
    /// Scores of a sample of the photos, on which the Gaussians were optimized, before and after.
    pub train: [Scores; 2],
    /// Number of photos in this sample.
    pub train_photos: usize,
    /// Scores of a sample of the held-out views during the optimization.
    pub curve: Vec<EvalPoint>,
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
    /// Options with their settings. `antialiased` is also set for an initial splat or state that is antialiased.
    options: RefineOptions,
    init: SceneInit<'a>,
    /// Number of Gaussians that the optimization ends with if it isn't ended early.
    pub gaussians: usize,
    /// Size that the photos were loaded at.
    pub size: PhotoSize,
    time: TimeBudget,
    on_event: Box<dyn FnMut(RefineEvent) -> bool + 'a>,
    is_stopped: bool,
    frame: LocalFrame,
    photos: Vec<View>,
    held_out: Vec<View>,
    /// Interval between the held-out views that there is time to score as a whole.
    scored_every: usize,
    start: Option<Start>,
    /// Number of photos that were left out as near duplicates.
    pub near_duplicates: usize,
    /// Name and checksum of each of the others.
    fingerprints: Vec<(String, u32)>,
    /// Depths of some photos, if Gaussians were created from them.
    depth_maps: Vec<DepthMap>,
    /// Quality of the capture, if Gaussians were created from photos and all depths are known.
    quality: Option<CaptureQuality>,
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
        options: &RefineOptions,
        init: SceneInit<'a>,
        mut on_event: impl FnMut(RefineEvent) -> bool + 'a,
    ) -> Result<Self> {
        let clock = options.started.unwrap_or_else(Instant::now);
        let options = options.resolve(init.is_splat())?;
        if let SceneInit::State(state) = init {
            state.check_options(&options)?;
        }
        let (gaussians, size) = init.sizes(capture, &options);
        let ([train, held_out], warning) = options.select_views(capture, size);
        if let Some(line) = warning {
            on_event(RefineEvent::Warning(&line));
        }
        let count = train.len() + held_out.len();
        let mut should_continue = |done: usize| on_event(RefineEvent::Loading { done, count });
        let over_black = options.mask_background.map(|_| capture.clone().over_black());
        let mut photos =
            load_photos(over_black.as_ref().unwrap_or(capture), &train, size, &mut should_continue)?;
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
            let names = format_names(&masked_out, SHOWN_NAMES);
            let line = format!("{}: masked out as a whole, and left out: {names}", capture.name);
            on_event(RefineEvent::Warning(&line));
        }
        let frame = LocalFrame::from_cameras(&capture.cameras());
        for view in photos.iter_mut().chain(&mut held_out) {
            view.camera = frame.camera_to_local(&view.camera);
        }
        Ok(RefineSession {
            capture,
            init,
            gaussians,
            size,
            time: TimeBudget::new(options.budget(), clock),
            options,
            on_event: Box::new(on_event),
            is_stopped: false,
            frame,
            photos,
            held_out,
            scored_every: 1,
            start: None,
            near_duplicates: 0,
            fingerprints: vec![],
            depth_maps: vec![],
            quality: None,
            log_exposures: None,
            steps: 0,
            curve: vec![],
        })
    }

    /// Returns the photos that the splat has to match, in the session's frame. After [`RefineSession::start`], near duplicates are removed.
    pub fn photos(&self) -> &[View] {
        &self.photos
    }

    /// Returns the quality of the capture, which [`RefineSession::start`] measures if Gaussians start from photos and there is time for all
    /// depths.
    pub fn quality(&self) -> Option<&CaptureQuality> {
        self.quality.as_ref()
    }

    /// Returns the held-out views, in the session's frame.
    pub fn held_out(&self) -> &[View] {
        &self.held_out
    }

    /// Returns the views that represent the splat's quality, in the session's frame: the held-out views if there are any, else the photos.
    fn representative_views(&self) -> &[View] {
        if self.held_out.is_empty() { &self.photos } else { &self.held_out }
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
        let (exposures, device) = (self.options.correct_exposures, self.options.device);
        let final_count = if self.init.is_splat() { 0 } else { self.gaussians as i64 };
        // Gaussians of a new optimizer, or the optimizer of a state.
        let (mut raw, mut optimizer) = (None, None);
        let gaussians = match self.init {
            SceneInit::Splat(splat) => {
                self.options.antialiased |= splat.antialiased;
                let local = Gaussians::from_splat(splat).to_local(&self.frame, splat.origin);
                let local = raw.insert(RawGaussians::from_gaussians(&local.to_device(device)));
                Gaussians { antialiased: splat.antialiased, ..local.activate() }
            }
            SceneInit::State(state) => {
                self.options.antialiased |= state.record.antialiased;
                if state.record.has_depths {
                    self.gaussians_from_photos(self.initial_count())?.ok_or_else(stopped)?;
                }
                if exposures == ExposureCorrection::Auto {
                    self.log_exposures = state.has_exposures().then(|| self.equal_exposures());
                }
                let known = GaussianOptimizer::from_state(state, &self.options, final_count)?;
                optimizer.insert(known).averaged_gaussians()
            }
            SceneInit::Model(loaded) => self.reconstruct(loaded)?,
            SceneInit::Photos => {
                if self.photos.len() < 2 {
                    let why = "one photo gives no depth: expected two or more, or an initial splat";
                    return Err(Error::request(why));
                }
                let new = self.gaussians_from_photos(self.initial_count())?.ok_or_else(stopped)?;
                Gaussians { antialiased: self.options.antialiased, ..raw.insert(new).activate() }
            }
        };
        if exposures == ExposureCorrection::On && self.log_exposures.is_none() {
            self.log_exposures = Some(self.equal_exposures());
        }
        let depth = match self.init {
            SceneInit::State(state) => state.record.depth,
            _ => scene_depth(&gaussians, &self.photos)?,
        };
        self.leave_out_near_duplicates(depth);
        self.fingerprints = self.fingerprint_photos()?;
        if let SceneInit::State(state) = self.init {
            self.check_photos(state)?;
        }
        let new = |raw: RawGaussians| GaussianOptimizer::new(&raw, depth, &self.options, final_count);
        let optimizer = optimizer.or_else(|| raw.map(new));
        self.start = Some(Start { gaussians: gaussians.map(Tensor::shallow_clone), depth, optimizer });
        Ok(gaussians)
    }

    /// Returns the reconstruction of the photos by a model.
    fn reconstruct(&self, loaded: &LoadedModel) -> Result<Gaussians> {
        let data = &loaded.config.data;
        let cameras: Vec<Camera> = self.photos.iter().map(|photo| photo.camera).collect();
        let all: Vec<usize> = (0..cameras.len()).collect();
        let context = spread_over_path(&cameras, &all, self.options.max_views.unwrap_or(data.context_views))
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
        self.options.initial_gaussians_for(self.gaussians)
    }

    /// Optimizes the result of [`RefineSession::start`], and scores a sample of the photos before and after.
    ///
    /// # Errors
    /// Fails if rendering fails.
    ///
    /// # Panics
    /// Panics if [`RefineSession::start`] was not called before.
    pub fn run(&mut self) -> Result<RefineResult> {
        let Start { gaussians: initial, depth, optimizer } =
            self.start.take().expect("a session that was started");
        self.time.reserve_for_writing(initial.count().max(self.gaussians as i64));
        let begun_scoring = Instant::now();
        let before = self.score_photos(&initial, &self.photo_opt(depth)?)?;
        let time = begun_scoring.elapsed();
        self.reserve(time);
        let train_photos = self.photos.len().div_ceil(sample_interval(&self.photos, u64::MAX));
        let each = time / train_photos as u32;
        self.scored_every = self.time.reserve_for_held_out(each, self.held_out.len());
        self.time.last_scoring = each * self.held_out_sample().len() as u32;
        if let Some(line) = self.time.late_start_warning() {
            self.warn(&line);
        }
        if matches!(self.init, SceneInit::Model(_)) {
            self.add_eval_point(&initial)?;
        }
        let begun = self.time.seconds();
        let mut ended = begun;
        let (mut gaussians, mut after) = (initial.map(Tensor::shallow_clone), before);
        let (mut is_initial, mut corrections, mut state) = (true, vec![], None);
        if !self.is_stopped {
            let (optimized, photo_opt, its_state) = self.optimize(&initial, optimizer)?;
            ended = self.time.seconds();
            let scores = self.score_photos(&optimized, &photo_opt)?;
            if !(scores.psnr.is_nan() || scores.psnr < before.psnr) {
                (gaussians, after, is_initial) = (optimized, scores, false);
                (corrections, state) = (photo_opt.report(&self.photos), Some(its_state));
            }
        }
        let splat = match self.init {
            SceneInit::Splat(splat) if is_initial => Splat { warnings: vec![], ..splat.clone() },
            _ => gaussians.to_world_units(&self.frame).to_splat(self.frame.origin)?,
        };
        Ok(RefineResult {
            splat,
            initial,
            gaussians,
            is_initial,
            corrections,
            steps: self.steps,
            seconds: [begun, ended],
            state,
            train: [before, after],
            train_photos,
            curve: std::mem::take(&mut self.curve),
        })
    }

    /// Scores a result on whole held-out views, with a time budget those that there is time for. Returns the scores before and after the
    /// optimization; `None` if no views are held out, or if `on_event` ended the scoring.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn score_held_out(&mut self, result: &RefineResult) -> Result<Option<[CaptureScores; 2]>> {
        let views = every(&self.held_out, self.scored_every);
        self.score_before_and_after(result, &views, None)
    }

    /// Returns the mean scores of the sample of [`EvalPoint`], given the scores of all views by [`RefineSession::score_held_out`].
    pub fn sample_scores(&self, scores: &CaptureScores) -> Scores {
        mean_of_every(scores, self.held_out_sample_interval())
    }

    /// Scores the initial and the final Gaussians by LPIPS, with the networks whose weights are installed: on all held-out views, or on a
    /// few photos if no views are held out. Returns `None` if `on_event` ends the scoring.
    ///
    /// # Errors
    /// Fails if rendering fails, or if a file of weights is invalid.
    pub fn score_lpips(&mut self, result: &RefineResult) -> Result<Option<[CaptureScores; 2]>> {
        let perceptual = Perceptual::new(result.initial.means.device());
        let mut views = every(self.representative_views(), 1);
        if self.held_out.is_empty() {
            views.truncate(LPIPS_PHOTOS);
        }
        let scores = self.score_before_and_after(result, &views, Some(&perceptual))?;
        if let Some(line) = scores.as_ref().and_then(|[_, after]| Perceptual::explain_missing(&after.mean)) {
            self.warn(&line);
        }
        Ok(scores)
    }

    /// Renders the held-out views, or else the photos, beside their photos: a row per view.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn contact_sheet(&self, result: &RefineResult) -> Result<ContactSheet> {
        ContactSheet::render(&result.gaussians, self.representative_views())
    }

    /// Scores the initial and the final Gaussians on whole views. Returns `None` if there are no views, or if `on_event` ends the scoring.
    fn score_before_and_after(
        &mut self,
        result: &RefineResult,
        views: &[View],
        perceptual: Option<&Perceptual>,
    ) -> Result<Option<[CaptureScores; 2]>> {
        let before = self.score_whole(&result.initial, views, perceptual)?;
        let after = match &before {
            Some(before) if result.is_initial => Some(before.clone()),
            Some(_) => self.score_whole(&result.gaussians, views, perceptual)?,
            None => None,
        };
        Ok(before.zip(after).map(<[CaptureScores; 2]>::from))
    }

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

    /// Scores Gaussians on a sample of the photos, to which corrections are applied.
    fn score_photos(&self, gaussians: &Gaussians, photo_opt: &PhotoOpt) -> Result<Scores> {
        let sample = self.photos.iter().enumerate().step_by(sample_interval(&self.photos, u64::MAX));
        let views: Vec<View> = sample.map(|(index, view)| photo_opt.apply(index, view)).collect();
        Ok(score_views("sample", gaussians, &views, None, |_| true)?.expect("at least one photo").mean)
    }

    /// Returns the interval between the views of the sample that is scored during the optimization, among those that are scored as a whole.
    fn held_out_sample_interval(&self) -> usize {
        sample_interval(&every(&self.held_out, self.scored_every), MAX_SAMPLE_PIXELS)
    }

    /// Returns the held-out views that are scored during the optimization.
    fn held_out_sample(&self) -> Vec<View> {
        every(&self.held_out, self.scored_every * self.held_out_sample_interval())
    }

    fn warn(&mut self, line: &str) {
        let _ = (self.on_event)(RefineEvent::Warning(line));
    }

    /// Returns the name of each photo, and the checksum of its file with its camera and mask.
    fn fingerprint_photos(&self) -> Result<Vec<(String, u32)>> {
        let indices: HashMap<&str, usize> = self.capture.names().zip(0..).collect();
        let names: Vec<&String> = self.photos.iter().map(|photo| &photo.name).collect();
        let capture = self.capture;
        names
            .par_iter()
            .map(|&name| Ok((name.clone(), capture.checksum([indices[name.as_str()]])?)))
            .collect()
    }

    /// Returns the origin and the scale of the frame.
    fn frame_numbers(&self) -> [f64; 4] {
        let [x, y, z] = self.frame.origin.to_array();
        [x, y, z, self.frame.scale]
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
        self.near_duplicates = left_out.len();
        if !left_out.is_empty() {
            let (name, count, names) =
                (&self.capture.name, left_out.len(), format_names(&left_out, SHOWN_NAMES));
            let line = "photos are nearly equal to others, and left out";
            self.warn(&format!("{name}: {count} of {all} {line}: {names}"));
        }
    }

    /// Creates `count` Gaussians on the session's device, and says that exposures are corrected if this was not requested. Returns `None` if
    /// the work is ended before any photo has depths.
    fn gaussians_from_photos(&mut self, count: usize) -> Result<Option<RawGaussians>> {
        let to_local = |point: Point| Point { position: self.frame.point_to_local(point.position), ..point };
        let points: Vec<Point> = read_points(self.capture)?.into_iter().map(to_local).collect();
        let mut is_stopped = false;
        let should_continue = |done: usize| {
            is_stopped |= !(self.on_event)(RefineEvent::Starting(done));
            !is_stopped && !self.time.is_late_for_depths(done)
        };
        let RefineOptions { seed, correct_exposures: correction, .. } = self.options;
        let side = self.options.sweep_side();
        let init =
            gaussians_from_photos(&self.photos, &points, count, side, seed, correction, should_continue);
        self.is_stopped |= is_stopped;
        let Some(PhotoInit { gaussians, depth_maps, log_exposures, quality }) = init else { return Ok(None) };
        let is_continued = matches!(self.init, SceneInit::State(_));
        if let (Some(gains), ExposureCorrection::Auto, false) = (&log_exposures, correction, is_continued) {
            let factors = gains.as_flattened().iter().map(|gain| gain.exp());
            let [min, max] = [factors.clone().fold(f64::MAX, f64::min), factors.fold(0., f64::max)];
            let line = "the exposures of neighboring photos differ, and all are corrected";
            self.warn(&format!("{}: {line}: {min:.2} to {max:.2} times the average", self.capture.name));
        }
        self.quality = quality.map(|quality| quality.in_world(&self.frame));
        self.depth_maps = depth_maps;
        self.log_exposures = log_exposures;
        Ok(Some(gaussians.to_device(self.options.device)))
    }

    /// Returns the exposures of photos that don't differ.
    fn equal_exposures(&self) -> Vec<LogGains> {
        vec![[0.; 3]; self.photos.len()]
    }

    /// Returns the corrections with which the optimization begins, those of a state if it continues from one.
    fn photo_opt(&self, depth: f64) -> Result<PhotoOpt> {
        let mut photo_opt = PhotoOpt::new(&self.photos, self.log_exposures.as_deref(), depth, &self.options);
        if let SceneInit::State(state) = self.init {
            photo_opt.load_state(state)?;
        }
        Ok(photo_opt)
    }

    /// Optimizes the Gaussians of `optimizer`, or the `initial` ones of a model and others, and the corrections of the photos.
    fn optimize(
        &mut self,
        initial: &Gaussians,
        optimizer: Option<GaussianOptimizer>,
    ) -> Result<(Gaussians, PhotoOpt, RefineState)> {
        let mut optimizer = match optimizer {
            Some(optimizer) => optimizer,
            None => {
                let raw = self.with_gaussians_from_photos(initial)?;
                let depth = scene_depth(&raw.activate(), &self.photos)?;
                GaussianOptimizer::new(&raw, depth, &self.options, self.gaussians as i64)
            }
        };
        let mut photo_opt = self.photo_opt(optimizer.depth)?;
        let (progress, earlier_total) = match self.init {
            SceneInit::State(state) => (state.record.progress, state.record.total),
            _ => Default::default(),
        };
        let options = self.options.clone();
        let args = OptimizeArgs {
            photos: &Photos::new(&self.photos, &self.depth_maps, &options),
            options: &options,
            budget: self.time.remaining(progress.time, earlier_total),
            progress,
        };
        let mut fractions = EVAL_FRACTIONS.iter().peekable();
        let (mut is_due, mut failure) = (false, None);
        let progress = refine(&mut optimizer, &mut photo_opt, &args, &mut Stopwatch::default(), |now| {
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
                    seconds: self.time.seconds(),
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
            photos: self.fingerprints.clone(),
            side: longest_side(&self.photos),
            frame: self.frame_numbers(),
            progress,
            total: earlier_total + self.time.elapsed(),
            depth: optimizer.depth,
            has_depths: !self.depth_maps.is_empty(),
            antialiased: self.options.antialiased,
            from_splat: self.init.is_splat(),
            settings: self.options.fixed_settings(),
            growth: optimizer.growth,
        };
        let (gaussians, corrections) = (optimizer.state(), photo_opt.state());
        let state = RefineState { record, gaussians, corrections, file: PathBuf::new(), sources: vec![] };
        Ok((optimizer.averaged_gaussians(), photo_opt, state))
    }

    /// Returns an error if `state` is that of other photos or cameras, or of larger photos.
    fn check_photos(&self, state: &RefineState) -> Result<()> {
        let Record { photos, side, frame, .. } = &state.record;
        let own_side = longest_side(&self.photos);
        if own_side < *side {
            let expected = format!("at most {own_side}, as in this refinement (--size)");
            return Err(Error::input(
                &state.file,
                "the size of the photos",
                format!("{side} pixels"),
                expected,
            ));
        }
        let names =
            |photos: &[(String, u32)]| photos.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
        if *frame != self.frame_numbers() || names(photos) != names(&self.fingerprints) {
            let found = format!("that of another refinement, {} photos", photos.len());
            let expected =
                format!("that of the {} photos of this one, with the same poses", self.photos.len());
            return Err(Error::input(&state.file, "the list of photos", found, expected));
        }
        match photos.iter().zip(&self.fingerprints).find(|(known, photo)| known != photo) {
            Some(((name, known), (_, checksum))) => {
                let field = format!("the checksum of {name} with its camera and mask");
                Err(Error::input(&state.file, field, format!("{known:08x}"), format!("{checksum:08x}")))
            }
            None => Ok(()),
        }
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
        Ok(most_visible(&raw, &self.depth_maps, of_model)?.to_device(self.options.device).concat(&new))
    }

    /// Scores the sample of the held-out views, if there are any, and appends the scores to the curve.
    fn add_eval_point(&mut self, gaussians: &Gaussians) -> Result<()> {
        let begun = Instant::now();
        if let Some(scores) = score_views("sample", gaussians, &self.held_out_sample(), None, |_| true)? {
            let point = EvalPoint { seconds: self.time.seconds(), steps: self.steps, scores: scores.mean };
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

/// Returns the interval between the views of an evenly spread sample of `views`: at most [`MAX_SAMPLE`] views, and two or so many that they
/// have at most `max_pixels` in all. Views are scored as a whole: a part of an image has other borders, near which large Gaussians are
/// projected differently.
fn sample_interval(views: &[View], max_pixels: u64) -> usize {
    let pixels = |view: &View| u64::from(view.camera.width) * u64::from(view.camera.height);
    let largest = views.iter().map(pixels).max().unwrap_or(1);
    let count = (max_pixels / largest).clamp(2, MAX_SAMPLE as u64) as usize;
    views.len().div_ceil(count).max(1)
}

/// Returns the first of every `interval` views.
fn every(views: &[View], interval: usize) -> Vec<View> {
    views.iter().step_by(interval).map(View::shallow_clone).collect()
}

/// Returns the mean scores of the first of every `interval` views.
fn mean_of_every(scores: &CaptureScores, interval: usize) -> Scores {
    Scores::mean(scores.views.iter().step_by(interval).map(|view| &view.scores))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::wall;
    use crate::refine::tests::start;

    /// A sample that is scored several times has few pixels, and its scores are those of its views.
    #[test]
    fn a_sample_has_few_pixels_and_its_scores_are_those_of_the_views() {
        let views = |width: u32, height: u32, count: usize| -> Vec<View> {
            let view = |index: usize| {
                let view = wall(0.25 * index as f64);
                let image = (view.image.to_float() + 0.02 * index as f64).into();
                View { image, camera: Camera { width, height, ..view.camera }, ..view }
            };
            (0..count).map(view).collect()
        };
        assert_eq!(sample_interval(&views(210, 170, 20), MAX_SAMPLE_PIXELS), 3);
        let large = views(1000, 600, 9);
        assert_eq!([MAX_SAMPLE_PIXELS, u64::MAX].map(|pixels| sample_interval(&large, pixels)), [5, 2]);
        assert_eq!((sample_interval(&[], MAX_SAMPLE_PIXELS), every(&[], 1).len()), (1, 0));
        let all = views(64, 64, 5);
        let gaussians = start(&all, 40, 0).activate();
        let score = |views: &[View]| score_views("", &gaussians, views, None, |_| true).unwrap().unwrap();
        let (sample, of_all) = (score(&every(&all, 2)).mean, score(&all));
        let selected = mean_of_every(&of_all, 2);
        assert!((sample.psnr - selected.psnr).abs() < 1e-9 && (sample.ssim - selected.ssim).abs() < 1e-9);
        assert!((sample.psnr - of_all.mean.psnr).abs() > 0.01, "{sample:?} {}", of_all.mean.psnr);
    }
}
