//! A refinement from a capture to Gaussians: photos are read, Gaussians are begun with, optimized, and scored on few pixels on the
//! way, all of it within one budget and in a frame of the capture's own (spec 2.5).

use super::begin::gaussians_from_photos;
use super::config::RefineConfig;
use super::corrections::{Correction, Corrections};
use super::patches::{PatchScores, Patches};
use super::photos::{Photos, distinct, load_photos};
use super::space::{GaussianSpace, Space, TokenSpace};
use super::{Budget, Task, refine, scene_depth};
use crate::data::{Capture, Point, View, points_of};
use crate::error::{Error, Result};
use crate::reconstruct::{LoadedModel, Reconstruction, reconstruct, spread_over_path};
use crate::render::transform;
use crate::scene::{Camera, Gaussians, ImageSize, LocalFrame, RawGaussians, Similarity};
use glam::{DMat4, DVec3};
use serde::Serialize;
use std::time::{Duration, Instant};
use tch::{Device, Tensor};

/// Share of the time or the steps that goes to tokens where Gaussians follow.
const TOKENS_SHARE: f64 = 0.2;
/// Goes to the optimization, however long the start took.
const MIN_TIME: Duration = Duration::from_secs(1);
/// Share of the time in which depths are looked for, at most, in more photos than a few.
const MAX_START_SHARE: f64 = 0.5;
const FEW_PHOTOS: usize = 2;
/// Share of the time that scoring on the way takes, at most.
const MAX_SCORING_SHARE: f64 = 0.03;
/// Parts of a phase at which views held out are scored.
const MARKS: [f64; 12] = [0., 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9];

/// What is optimized.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SpaceKind {
    /// Gaussians, each by itself.
    Gaussians,
    /// The tokens from which a model decodes them.
    Tokens,
    /// Tokens first, then Gaussians.
    Both,
}

/// What a session does, and how long.
#[derive(Debug, Clone)]
pub struct RefineOptions {
    /// Numbers of the method.
    pub config: RefineConfig,
    /// What is optimized.
    pub space: SpaceKind,
    /// How long: a time counts from the clock that the session is given, reading and the start included.
    pub budget: Budget,
    /// How many Gaussians, where the splat that is begun with doesn't say.
    pub gaussians: usize,
    /// Of the random numbers.
    pub seed: u64,
    /// Also learn how far each camera is from where it was said to be.
    pub correct_poses: bool,
    /// Also learn by what each photo is brighter than the others.
    pub correct_exposures: bool,
    /// What photos are cut and resized to; where none is given, they keep their shape, and are made smaller where they are large.
    pub size: Option<ImageSize>,
    /// Where depths are found, and what is optimized lies.
    pub device: Device,
}

/// What is begun with.
#[derive(Debug, Clone, Copy)]
pub enum Initial<'a> {
    /// Pixels, at depths on which the photos agree.
    Photos,
    /// A splat, in the capture's world, with means relative to an origin.
    Splat(&'a Gaussians, DVec3),
    /// What a model makes of the photos.
    Model {
        /// The model.
        loaded: &'a LoadedModel,
        /// How many photos it sees at most; where none is given, as many as its configuration says.
        views: Option<usize>,
    },
}

/// What a session is doing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RefineEvent {
    /// So many photos are read.
    Loading(usize),
    /// In so many photos depths are found.
    Starting(usize),
    /// Steps are done.
    Optimizing {
        /// How many, in all phases.
        steps: u64,
        /// Of patches of the views held out, in dB, when they were last scored.
        psnr: Option<f64>,
    },
}

/// Scores of the views held out, at one time of the work.
#[derive(Debug, Clone, Serialize)]
pub struct EvalPoint {
    /// By the session's clock.
    pub seconds: f64,
    /// Steps done.
    pub steps: u64,
    /// The scores.
    #[serde(flatten)]
    pub scores: PatchScores,
}

/// What a session ends with.
#[derive(Debug)]
pub struct RefineResult {
    /// The Gaussians, in the session's frame and on its device.
    pub gaussians: Gaussians,
    /// Whether these are the ones begun with, which showed the photos better.
    pub is_initial: bool,
    /// What was learned of each photo, where it was asked for.
    pub corrections: Vec<Correction>,
    /// Steps done.
    pub steps: u64,
    /// When the optimization began and when it ended, by the session's clock.
    pub seconds: [f64; 2],
    /// Of patches of the photos, before and after.
    pub shown: [PatchScores; 2],
    /// Of patches of the views held out, on the way.
    pub curve: Vec<EvalPoint>,
}

/// What was begun with.
enum Start<'a> {
    Gaussians(RawGaussians),
    Model(&'a LoadedModel, Box<Reconstruction>),
}

/// Photos and what is made of them, in the local frame of the capture's cameras. First [`RefineSession::load`], then
/// [`RefineSession::start`], then [`RefineSession::run`].
pub struct RefineSession<'a> {
    capture: &'a Capture,
    options: &'a RefineOptions,
    clock: Instant,
    watch: Box<dyn FnMut(RefineEvent) -> bool + 'a>,
    is_stopped: bool,
    frame: LocalFrame,
    photos: Vec<View>,
    held_out: Vec<View>,
    patches_held_out: Patches,
    start: Option<(Start<'a>, Gaussians, f64)>,
    near_duplicates: usize,
    warnings: Vec<String>,
    reserve: Duration,
    scoring: Duration,
    last_scoring: Duration,
    steps: u64,
    curve: Vec<EvalPoint>,
}

impl<'a> RefineSession<'a> {
    /// Reads the photos `shown` and `held_out`. `clock` is when the time of the budget began. `watch` sees what goes on, and ends the
    /// work by false.
    ///
    /// # Errors
    /// Those of [`load_photos`], and an end before all photos are read.
    pub fn load(
        capture: &'a Capture,
        shown: &[usize],
        held_out: &[usize],
        options: &'a RefineOptions,
        clock: Instant,
        mut watch: impl FnMut(RefineEvent) -> bool + 'a,
    ) -> Result<Self> {
        let mut go_on = |done: usize| watch(RefineEvent::Loading(done));
        let mut photos = load_photos(capture, shown, options.size, &mut go_on)?;
        let mut held_out = load_photos(capture, held_out, options.size, |done| go_on(photos.len() + done))?;
        let frame = LocalFrame::from_cameras(&capture.cameras());
        for view in photos.iter_mut().chain(&mut held_out) {
            view.camera = frame.camera_to_local(&view.camera);
        }
        Ok(RefineSession {
            capture,
            options,
            clock,
            watch: Box::new(watch),
            is_stopped: false,
            frame,
            patches_held_out: Patches::of(&held_out),
            photos,
            held_out,
            start: None,
            near_duplicates: 0,
            warnings: vec![],
            reserve: Duration::ZERO,
            scoring: Duration::ZERO,
            last_scoring: Duration::ZERO,
            steps: 0,
            curve: vec![],
        })
    }

    /// Returns Gaussians of the session's frame in the capture's unit and along its axes, with means relative to the place that is
    /// returned beside them.
    pub fn to_world(&self, gaussians: &Gaussians) -> (Gaussians, DVec3) {
        (self.frame.gaussians_from_local(gaussians), self.frame.origin)
    }

    /// The photos that the splat has to match, in the session's frame: those that were read, without near duplicates once there is a start.
    pub fn photos(&self) -> &[View] {
        &self.photos
    }

    /// The views held out, in the session's frame.
    pub fn held_out(&self) -> &[View] {
        &self.held_out
    }

    /// What is to be told, a sentence each: what was left out, and what the photos don't tell.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// How many photos were left out, as they are nearly equal to others.
    pub fn near_duplicates(&self) -> usize {
        self.near_duplicates
    }

    /// Returns a sentence where reading the photos and the start took so long that little of the time, or nothing, is left for the
    /// optimization.
    pub fn is_late(&self) -> Option<String> {
        let Budget::Time(time) = self.options.budget else { return None };
        let gone = self.clock.elapsed();
        (gone + self.reserve + MIN_TIME.min(time) > time).then(|| {
            let (time, gone) = (time.as_secs_f64(), gone.as_secs_f64());
            format!("{time:.0} s are too short here: reading the photos and beginning took {gone:.1} s; it ends as soon as it can")
        })
    }

    /// Keeps so much of the time for what comes after the optimization.
    pub fn reserve(&mut self, time: Duration) {
        self.reserve = time;
    }

    /// Makes what is begun with, and returns it, in the session's frame and on its device. Photos that are nearly equal to others are left
    /// out from then on.
    ///
    /// # Errors
    /// What the model or the rasterizer refuses, a splat that no camera sees, and an end before there is anything.
    pub fn start(&mut self, initial: Initial<'a>) -> Result<Gaussians> {
        let start = match initial {
            Initial::Splat(gaussians, origin) => {
                let local = self.frame.gaussians_to_local(gaussians, origin);
                Start::Gaussians(RawGaussians::of(&local.to_device(self.options.device)))
            }
            Initial::Model { loaded, views } => {
                let data = &loaded.config.data;
                let all: Vec<usize> = (0..self.photos.len()).collect();
                let context = spread_over_path(&self.cameras(), &all, views.unwrap_or(data.context_views))
                    .into_iter()
                    .map(|index| self.photos[index].fitted(data.image_size))
                    .collect::<Result<Vec<_>>>()?;
                Start::Model(loaded, Box::new(reconstruct(loaded, &context, &[])?))
            }
            Initial::Photos => {
                if self.photos.len() < 2 {
                    let why = "one photo tells no depth: two or more are expected, or a splat to begin with";
                    return Err(Error::Request(why.into()));
                }
                if self.are_in_one_place() {
                    let line = "the photos were all taken from one place, and tell no depth: all that they show is put at one distance";
                    self.warnings.push(format!("{}: {line}", self.capture.name));
                }
                Start::Gaussians(self.gaussians_from_photos(None)?.ok_or_else(stopped)?)
            }
        };
        let gaussians = match &start {
            Start::Gaussians(raw) => raw.activate(),
            Start::Model(_, reconstruction) => reconstruction.in_world(),
        };
        let depth = scene_depth(&gaussians, &self.photos)?;
        self.leave_out_near_duplicates(depth);
        self.start = Some((start, gaussians.map(Tensor::shallow_clone), depth));
        Ok(gaussians)
    }

    /// Optimizes what [`RefineSession::start`] made, and scores patches of the photos before and after.
    ///
    /// # Errors
    /// What the rasterizer refuses.
    ///
    /// # Panics
    /// There is no start.
    pub fn run(&mut self) -> Result<RefineResult> {
        let (start, initial, depth) = self.start.take().expect("a start");
        let patches = Patches::of(&self.photos);
        let before = patches.score(&initial)?.expect("photos");
        if matches!(start, Start::Model(..)) {
            self.add_eval_point(&initial)?;
        }
        let begun = self.clock.elapsed().as_secs_f64();
        let (gaussians, learned) = if self.is_stopped {
            (initial.map(Tensor::shallow_clone), Corrections::none())
        } else {
            self.optimize(&start, &initial, depth)?
        };
        let ended = self.clock.elapsed().as_secs_f64();
        let after = patches.corrected(&learned).score(&gaussians)?.expect("photos");
        let is_initial = after.psnr.is_nan() || after.psnr < before.psnr;
        let asked = self.options.correct_poses || self.options.correct_exposures;
        let corrections = if asked && !is_initial { learned.told(&self.photos) } else { vec![] };
        Ok(RefineResult {
            gaussians: if is_initial { initial } else { gaussians },
            is_initial,
            corrections,
            steps: self.steps,
            seconds: [begun, ended],
            shown: if is_initial { [before; 2] } else { [before, after] },
            curve: std::mem::take(&mut self.curve),
        })
    }

    fn cameras(&self) -> Vec<Camera> {
        self.photos.iter().map(|photo| photo.camera).collect()
    }

    fn are_in_one_place(&self) -> bool {
        let centre = |view: &View| view.camera.c2w.w_axis;
        self.photos.iter().all(|view| centre(view) == centre(&self.photos[0]))
    }

    fn leave_out_near_duplicates(&mut self, depth: f64) {
        let keep = distinct(&self.photos, depth);
        if keep.len() == self.photos.len() {
            return;
        }
        let mut is_kept = vec![false; self.photos.len()];
        keep.iter().for_each(|&index| is_kept[index] = true);
        let mut left_out = vec![];
        let photos = std::mem::take(&mut self.photos);
        for (photo, is_kept) in photos.into_iter().zip(is_kept) {
            if is_kept { self.photos.push(photo) } else { left_out.push(photo.name) }
        }
        self.near_duplicates = left_out.len();
        let (count, all) = (left_out.len(), left_out.len() + self.photos.len());
        self.warnings.push(format!(
            "{}: {count} of {all} photos are nearly equal to others, and left out: {}",
            self.capture.name,
            names(&left_out)
        ));
    }

    /// As many Gaussians as were asked for, on the session's device; of `known` ones, those that can be where they are. None where the
    /// work is ended before any photo has depths.
    fn gaussians_from_photos(&mut self, known: Option<&RawGaussians>) -> Result<Option<RawGaussians>> {
        let to_local = |point: Point| Point { position: self.frame.point_to_local(point.position), ..point };
        let points: Vec<Point> = points_of(self.capture)?.into_iter().map(to_local).collect();
        let (clock, budget, watch) = (self.clock, self.options.budget, &mut self.watch);
        let mut is_stopped = false;
        let go_on = |done: usize| {
            is_stopped |= !watch(RefineEvent::Starting(done));
            let is_late = match budget {
                Budget::Steps(_) => false,
                Budget::Time(time) => done >= FEW_PHOTOS && clock.elapsed() > time.mul_f64(MAX_START_SHARE),
            };
            !is_stopped && !is_late
        };
        let RefineOptions { gaussians, seed, device, .. } = *self.options;
        let made = gaussians_from_photos(&self.photos, &points, known, gaussians, seed, device, go_on);
        self.is_stopped |= is_stopped;
        Ok(made)
    }

    /// In one space, or in one after the other; photos are corrected with Gaussians alone. `initial` are those of `start`,
    /// `depth` is theirs.
    fn optimize(
        &mut self,
        start: &Start,
        initial: &Gaussians,
        depth: f64,
    ) -> Result<(Gaussians, Corrections)> {
        let end = match self.options.space {
            SpaceKind::Gaussians => 0.,
            SpaceKind::Tokens => 1.,
            SpaceKind::Both => TOKENS_SHARE,
        };
        let (raw, depth, done) = match start {
            Start::Gaussians(raw) => (raw.shallow_clone(), depth, 0.),
            Start::Model(loaded, reconstruction) => {
                let gaussians = if end > 0. {
                    self.optimize_tokens(loaded, reconstruction, depth, end)?
                } else {
                    initial.map(Tensor::shallow_clone)
                };
                if end == 1. || self.is_stopped {
                    return Ok((gaussians, Corrections::none()));
                }
                let raw = self.filled(&gaussians)?;
                let depth = scene_depth(&raw.activate(), &self.photos)?;
                (raw, depth, end)
            }
        };
        let options = self.options;
        let mut space = GaussianSpace::new(&raw, depth, &options.config);
        let RefineOptions { correct_poses, correct_exposures, config, device, .. } = options;
        let count = self.photos.len();
        let mut corrections =
            Corrections::new(count, *correct_poses, *correct_exposures, depth, config, *device);
        let poses: Vec<DMat4> = self.cameras().iter().map(|camera| camera.c2w).collect();
        Ok((self.run_phase(&mut space, &mut corrections, &poses, depth, [done, 1.], None)?, corrections))
    }

    /// What tokens become until `end` of the way. They know the normalized world alone.
    fn optimize_tokens(
        &mut self,
        loaded: &LoadedModel,
        reconstruction: &Reconstruction,
        depth: f64,
        end: f64,
    ) -> Result<Gaussians> {
        let world = &reconstruction.world_from_normalized;
        let poses: Vec<DMat4> = self.cameras().iter().map(|camera| world.pose_before(&camera.c2w)).collect();
        let mut space =
            TokenSpace::new(&loaded.model, loaded.stage, &reconstruction.tokens, &self.options.config);
        let depth = depth / world.scale;
        self.run_phase(&mut space, &mut Corrections::none(), &poses, depth, [0., end], Some(world))
    }

    /// As many Gaussians as are to be, at the least: those that are missing lie where the photos agree, and in place of those that
    /// can't be where they are.
    fn filled(&mut self, gaussians: &Gaussians) -> Result<RawGaussians> {
        let mut raw = RawGaussians::of(gaussians);
        if self.photos.len() < 2 || gaussians.count() >= self.options.gaussians as i64 {
            return Ok(raw);
        }
        // Spherical harmonics follow when they do for the others.
        raw.sh = raw.sh.narrow(2, 0, 1);
        Ok(self.gaussians_from_photos(Some(&raw))?.unwrap_or(raw))
    }

    /// Optimizes from the part `from` of the way to `to`. `poses` are those of the photos in the world of `space`, `world` the way from
    /// there to the session's frame, in which the Gaussians are returned.
    fn run_phase(
        &mut self,
        space: &mut dyn Space,
        corrections: &mut Corrections,
        poses: &[DMat4],
        depth: f64,
        [from, to]: [f64; 2],
        world: Option<&Similarity>,
    ) -> Result<Gaussians> {
        let in_world = |gaussians: Gaussians| match world {
            Some(world) => transform(&gaussians, world),
            None => gaussians,
        };
        let RefineOptions { config, seed, device, .. } = self.options;
        let photos = Photos::new(&self.photos, poses, config.levels(), *device);
        let budget = match self.options.budget {
            Budget::Steps(steps) => Budget::Steps(((to - from) * steps as f64).round() as u64),
            Budget::Time(time) => {
                let left = time.saturating_sub(self.reserve).saturating_sub(self.clock.elapsed());
                Budget::Time(left.max(MIN_TIME.min(time)).mul_f64((to - from) / (1. - from)))
            }
        };
        let task = Task { photos: &photos, depth, config, budget, seed: *seed };
        let before = self.steps;
        let mut marks = MARKS.iter().peekable();
        let (mut is_due, mut failure) = (false, None);
        let gaussians = refine(space, corrections, &task, |at| {
            self.steps = before + at.step;
            while marks.next_if(|&&mark| at.progress >= mark).is_some() {
                is_due = true;
            }
            if is_due && self.may_score() {
                is_due = false;
                failure = self.add_eval_point(&in_world(at.gaussians())).err();
            }
            let psnr = self.curve.last().map(|point| point.scores.psnr);
            self.is_stopped |= !(self.watch)(RefineEvent::Optimizing { steps: self.steps, psnr });
            failure.is_none() && !self.is_stopped
        })?;
        match failure {
            Some(error) => Err(error),
            None => Ok(in_world(gaussians)),
        }
    }

    /// Whether scores on the way are so cheap, beside what was done since the clock began, that another one hardly shows.
    fn may_score(&self) -> bool {
        let scoring = self.scoring + self.last_scoring;
        scoring.as_secs_f64() <= MAX_SCORING_SHARE * self.clock.elapsed().as_secs_f64()
    }

    /// Scores patches of the views held out, if there are any.
    fn add_eval_point(&mut self, gaussians: &Gaussians) -> Result<()> {
        let begun = Instant::now();
        if let Some(scores) = self.patches_held_out.score(gaussians)? {
            let seconds = self.clock.elapsed().as_secs_f64();
            self.curve.push(EvalPoint { seconds, steps: self.steps, scores });
        }
        self.last_scoring = begun.elapsed();
        self.scoring += self.last_scoring;
        Ok(())
    }
}

/// The error of a session that is ended before there is anything to keep.
fn stopped() -> Error {
    Error::Failed("stopped before there was a splat: nothing is written".into())
}

/// A few of the names, and how many there are more.
fn names(all: &[String]) -> String {
    const FEW: usize = 3;
    let few = all[..all.len().min(FEW)].join(", ");
    if all.len() > FEW { format!("{few} and {} more", all.len() - FEW) } else { few }
}
