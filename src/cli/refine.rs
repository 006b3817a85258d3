use super::progress::{self, Progress};
use super::{check_views, memory, model, parse_size, print_json, stop_flag};
use anyhow::Result;
use clap::{Args, ValueEnum};
use glam::DMat4;
use globalsplat::data::{Capture, Holdout, View, open_capture, points_of};
use globalsplat::error::Error;
use globalsplat::eval::{CaptureScores, Perceptual, contact_sheet, judge_pictures};
use globalsplat::io::{
    Inputs, Splat, check_writable_png, check_writable_splat, read_splat, weights_files, write_png,
    write_splat_for,
};
use globalsplat::model::Precision;
use globalsplat::reconstruct::{LoadedModel, Reconstruction, reconstruct, spread_over_path};
use globalsplat::refine::{
    Budget, Correction, Corrections, GaussianSpace, Photos, RefineConfig, Space, Task, TokenSpace,
    gaussians_from_photos, load_photos, refine, scene_depth,
};
use globalsplat::render::{Rendered, render_views, transform};
use globalsplat::scene::{Camera, Gaussians, RawGaussians, Similarity};
use serde::Serialize;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tch::{Device, Tensor};

/// Of the time or the steps, what goes to tokens where Gaussians follow.
const TOKENS_SHARE: f64 = 0.2;
/// As many as the models of the paper's main size make.
pub const DEFAULT_GAUSSIANS: u32 = 16_384;
/// For the optimization, however long the beginning took.
const LEAST_SECONDS: f64 = 1.;
/// Parts of a phase at which views held out are scored.
const MARKS: [f64; 12] = [0., 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9];

/// Make a splat sharp on the photos of its scene, or make one of the photos alone.
///
/// Its Gaussians, as many as there are, are optimized until they show what the photos show. Without --splat they begin where the
/// photos agree on what is seen; no weights are needed, and no GPU. Ctrl-C ends the work early and keeps what there is.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat refine --scene captures/room --out room.ply\n  \
    globalsplat refine --splat room.ply --scene captures/room --out better.ply --seconds 30\n  \
    globalsplat refine --scene captures/room --holdout every:8 --sheet views.png --out room.ply")]
pub struct Refine {
    /// The splat to begin with, in the capture's world: .ply, .compressed.ply, .spz or .splat
    #[arg(long, value_name = "FILE", conflicts_with = "gaussians")]
    pub splat: Option<PathBuf>,
    /// What to begin with where there is no splat: the photos alone, or what a model makes of them
    #[arg(long, value_enum, conflicts_with = "splat")]
    pub from: Option<From>,
    /// Weights that `globalsplat export` wrote, to begin with; by default those that come with this program
    #[arg(long, value_name = "FILE", conflicts_with = "splat")]
    pub weights: Option<PathBuf>,
    /// What is optimized: Gaussians, the tokens that a model decodes them from, or these first and then those
    #[arg(long, value_enum, default_value_t = SpaceName::Gaussians, conflicts_with = "splat")]
    pub space: SpaceName,
    /// The capture: a folder with a cameras.json, a transforms.json or a COLMAP model, or CHUNK.torch#KEY
    #[arg(long, value_name = "PATH")]
    pub scene: PathBuf,
    /// The splat to write, of one of these endings
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// How many Gaussians, where none were begun with, or a model's that are fewer
    #[arg(long, value_name = "N", default_value_t = DEFAULT_GAUSSIANS, value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    pub gaussians: u32,
    /// How long, all in all
    #[arg(long, value_name = "S", default_value_t = 60., conflicts_with = "steps")]
    pub seconds: f64,
    /// How many steps instead: the same steps and seed give the same bytes
    #[arg(long, value_name = "N")]
    pub steps: Option<u64>,
    /// Other random numbers for another seed
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub seed: u64,
    /// Views to keep out and to score by: every:N, every:N+K or none
    #[arg(long, value_name = "WHICH", default_value = "none")]
    pub holdout: String,
    /// Use so many of the other views at most, spread over the path of the camera
    #[arg(long, value_name = "N")]
    pub views: Option<usize>,
    /// Cut and resize photos to this; by default they keep their shape, with 512 pixels along the longer side at most
    #[arg(long, value_name = "WxH")]
    pub size: Option<String>,
    /// Also learn how far each camera is from where it was said to be
    #[arg(long)]
    pub correct_poses: bool,
    /// Also learn by what each photo is brighter, or of another white, than the others
    #[arg(long)]
    pub correct_exposures: bool,
    /// Also write a picture: photo, render and depth side by side, a row per view held out, or else per view
    #[arg(long, value_name = "FILE.png")]
    pub sheet: Option<PathBuf>,
    /// Change a number of the method, as in views=4; docs/refine.md has them
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Print what was done as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// What is begun with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum From {
    /// Pixels, where the photos agree
    Nothing,
    /// What a model makes of the photos; of pixels, what its Gaussians lack to --gaussians
    Weights,
}

/// What is optimized.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SpaceName {
    /// Each by itself
    Gaussians,
    /// A model's
    Tokens,
    /// Tokens first
    Both,
}

/// What is begun with.
enum Start {
    Gaussians(RawGaussians),
    Model(Box<LoadedModel>, Reconstruction),
}

impl Refine {
    pub fn run(self) -> Result<()> {
        memory::keep();
        check_views(self.views)?;
        let holdout = self.holdout.parse::<Holdout>().map_err(Error::Request)?;
        let size = self.size.as_deref().map(parse_size).transpose()?;
        let config = RefineConfig::with(&self.set, self.splat.is_some())?;
        if !(self.seconds > 0. && self.seconds.is_finite()) {
            return Err(Error::Request(format!("--seconds is {}, expected more than 0", self.seconds)).into());
        }
        if self.space == SpaceName::Tokens && (self.correct_poses || self.correct_exposures) {
            let why = "--space tokens corrects no photos; --correct-poses and --correct-exposures go with gaussians or both";
            return Err(Error::Request(why.into()).into());
        }
        check_writable_splat(&self.out)?;
        if let Some(sheet) = &self.sheet {
            check_writable_png(sheet)?;
        }
        let capture = open_capture(&self.scene)?;
        self.check_outputs(&capture)?;
        let (shown, held_out) = holdout.split(capture.len());
        let shown = spread_over_path(&capture.cameras(), &shown, self.views.unwrap_or(usize::MAX).max(1));
        let photos = load_photos(&capture, &shown, size)?;
        let held_out = load_photos(&capture, &held_out, size)?;
        let judge =
            Judge { name: capture.name.clone(), held_out, perceptual: Perceptual::find(Device::Cpu)? };

        let clock = Instant::now();
        let start = self.start(&capture, &photos)?;
        let begin_seconds = clock.elapsed().as_secs_f64();
        let first = match &start {
            Start::Gaussians(raw) => raw.activate(),
            Start::Model(_, made) => made.in_world(),
        };
        let before = judge.scores_of_both(&first, &photos)?;
        let mut work = Work {
            asked: &self,
            capture: &capture,
            photos: &photos,
            judge: &judge,
            config: &config,
            seconds: (self.seconds - begin_seconds).max(LEAST_SECONDS),
            stop: stop_flag()?,
            bar: progress::bar(1000, "‰"),
            done_steps: 0,
            done_seconds: begin_seconds,
            curve: vec![],
        };
        if let (Start::Model(..), Some(scores)) = (&start, &before.held_out) {
            work.keep(scores);
        }
        let (mut gaussians, corrections) = work.optimize(&start, &first)?;
        work.bar.finish_and_clear();
        let mut after = judge.scores_of_both(&gaussians, &corrections.applied(&photos))?;
        let mut corrected =
            if self.correct_poses || self.correct_exposures { corrections.told(&photos) } else { vec![] };
        if after.shown.psnr < before.shown.psnr {
            eprintln!("the photos were shown better before: what was begun with is kept");
            (gaussians, after) = (first, before.clone());
            corrected.clear();
        }
        write_splat_for(&self.out, &Splat::of(&gaussians)?, &capture.cameras())?;
        if let Some(sheet) = &self.sheet {
            let views = if judge.held_out.is_empty() { &photos } else { &judge.held_out };
            write_png(sheet, &contact_sheet(views, &rendered(&gaussians, views)?))?;
        }
        let Work { done_steps: steps, done_seconds: seconds, curve, .. } = work;
        let (out, count) = (self.out.display(), gaussians.count());
        if self.json {
            let mut object = json!({
                "splat": self.out, "gaussians": count, "photos": photos.len(), "steps": steps, "seconds": seconds,
                "begin_seconds": begin_seconds, "corrections": corrected,
                "shown": { "before": means(&before.shown), "after": means(&after.shown) },
            });
            if let (Some(before), Some(after)) = (&before.held_out, &after.held_out) {
                object["held_out"] = json!({
                    "views": after.views.len(), "before": means(before), "after": means(after), "curve": curve,
                });
            }
            print_json(&object);
            return Ok(());
        }
        println!("{out}: {count} Gaussians, {steps} steps in {seconds:.0} s");
        println!("{:<24} {:>14} {:>8} {:>8}", "", "PSNR before", "after", "SSIM");
        let row = |name: String, before: &CaptureScores, after: &CaptureScores| {
            println!("{name:<24} {:>14.2} {:>8.2} {:>8.4}", before.psnr, after.psnr, after.ssim);
        };
        row(format!("{} photos", photos.len()), &before.shown, &after.shown);
        if let (Some(before), Some(after)) = (&before.held_out, &after.held_out) {
            row(format!("{} views held out", after.views.len()), before, after);
        }
        if let Some(line) = told_of(&corrected) {
            println!("{line}");
        }
        Ok(())
    }

    /// Refuses outputs that would replace what is read, but for the splat that is begun with.
    fn check_outputs(&self, capture: &Capture) -> Result<()> {
        let mut inputs = Inputs::default();
        capture.add_inputs(&mut inputs);
        let weights = self.weights.iter().flat_map(|path| weights_files(path));
        weights.for_each(|file| inputs.add(&file));
        inputs.check_file(&self.out)?;
        self.splat.iter().chain([&self.out]).for_each(|splat| inputs.add(splat));
        Ok(self.sheet.iter().try_for_each(|sheet| inputs.check_file(sheet))?)
    }

    /// Gaussians where the photos agree, those of a file, or what a model makes of the photos.
    fn start(&self, capture: &Capture, photos: &[View]) -> Result<Start> {
        if let Some(path) = &self.splat {
            return Ok(Start::Gaussians(RawGaussians::of(&read_splat(path)?.gaussians)));
        }
        let needs_model = self.weights.is_some() || self.space != SpaceName::Gaussians;
        if self.from == Some(From::Nothing) && needs_model {
            let why = "--from nothing has neither weights nor tokens; --from weights has";
            return Err(Error::Request(why.into()).into());
        }
        if self.from == Some(From::Weights) || needs_model {
            let loaded = model::load(self.weights.as_deref(), Some(Precision::F32), Device::Cpu)?;
            let data = &loaded.config.data;
            let cameras: Vec<Camera> = photos.iter().map(|photo| photo.camera).collect();
            let all: Vec<usize> = (0..photos.len()).collect();
            let context = spread_over_path(&cameras, &all, self.views.unwrap_or(data.context_views))
                .into_iter()
                .map(|index| photos[index].fitted(data.image_size))
                .collect::<globalsplat::Result<Vec<_>>>()?;
            let made = reconstruct(&loaded, &context, &[])?;
            return Ok(Start::Model(Box::new(loaded), made));
        }
        if photos.len() < 2 {
            let why = "one photo tells no depth: two or more are expected, or a --splat";
            return Err(Error::Request(why.into()).into());
        }
        Ok(Start::Gaussians(self.gaussians_of(capture, photos, None)?))
    }

    /// As many Gaussians as were asked for; of `known` ones, those that can be where they are.
    fn gaussians_of(
        &self,
        capture: &Capture,
        photos: &[View],
        known: Option<&RawGaussians>,
    ) -> Result<RawGaussians> {
        let points = points_of(capture)?;
        Ok(gaussians_from_photos(photos, &points, known, self.gaussians as usize, self.seed))
    }
}

/// The optimization, and how far it is.
struct Work<'a> {
    asked: &'a Refine,
    capture: &'a Capture,
    photos: &'a [View],
    judge: &'a Judge,
    config: &'a RefineConfig,
    /// All in all, once it has begun.
    seconds: f64,
    stop: Arc<AtomicBool>,
    bar: Progress,
    done_steps: u64,
    /// Without the time that scoring takes.
    done_seconds: f64,
    curve: Vec<Mark>,
}

/// What views held out scored on the way.
#[derive(Serialize)]
struct Mark {
    seconds: f64,
    steps: u64,
    psnr: f64,
    ssim: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    lpips_vgg: Option<f64>,
}

impl Work<'_> {
    /// In one space, or in one after the other; photos are corrected with Gaussians alone. `first` are those of `start` in the
    /// capture's world.
    fn optimize(&mut self, start: &Start, first: &Gaussians) -> Result<(Gaussians, Corrections)> {
        let asked = self.asked;
        let end = match asked.space {
            SpaceName::Gaussians => 0.,
            SpaceName::Tokens => 1.,
            SpaceName::Both => TOKENS_SHARE,
        };
        let (raw, done) = match start {
            Start::Gaussians(raw) => (raw.shallow_clone(), 0.),
            Start::Model(loaded, made) => {
                let gaussians = if end > 0. {
                    self.through_tokens(loaded, made, first, end)?
                } else {
                    first.map(Tensor::shallow_clone)
                };
                if end == 1. || self.stop.load(Ordering::Relaxed) {
                    return Ok((gaussians, Corrections::none()));
                }
                (self.filled(&gaussians)?, end)
            }
        };
        let depth = scene_depth(&raw.activate(), self.photos)?;
        let mut space = GaussianSpace::new(&raw, depth, self.config);
        let (count, config) = (self.photos.len(), self.config);
        let mut corrections =
            Corrections::new(count, asked.correct_poses, asked.correct_exposures, depth, config);
        let poses: Vec<DMat4> = self.photos.iter().map(|view| view.camera.c2w).collect();
        Ok((self.phase(&mut space, &mut corrections, &poses, depth, [done, 1.], None)?, corrections))
    }

    /// What tokens become until `end` of the way. They know the normalized world alone.
    fn through_tokens(
        &mut self,
        loaded: &LoadedModel,
        made: &Reconstruction,
        first: &Gaussians,
        end: f64,
    ) -> Result<Gaussians> {
        let world = &made.world_from_normalized;
        let poses: Vec<DMat4> = self.photos.iter().map(|view| world.pose_before(&view.camera.c2w)).collect();
        let mut space = TokenSpace::new(&loaded.model, loaded.stage, &made.tokens, self.config);
        let depth = scene_depth(first, self.photos)? / world.scale;
        self.phase(&mut space, &mut Corrections::none(), &poses, depth, [0., end], Some(world))
    }

    /// As many Gaussians as are to be, at the least: those that are missing lie where the photos agree, and in place of those that
    /// can't be where they are.
    fn filled(&mut self, gaussians: &Gaussians) -> Result<RawGaussians> {
        let mut raw = RawGaussians::of(gaussians);
        if self.photos.len() < 2 || gaussians.count() >= i64::from(self.asked.gaussians) {
            return Ok(raw);
        }
        let clock = Instant::now();
        // Spherical harmonics follow when they do for the others.
        raw.sh = raw.sh.narrow(2, 0, 1);
        let filled = self.asked.gaussians_of(self.capture, self.photos, Some(&raw))?;
        let seconds = clock.elapsed().as_secs_f64();
        self.done_seconds += seconds;
        self.seconds = (self.seconds - seconds).max(LEAST_SECONDS);
        Ok(filled)
    }

    /// The part of the way from `from` to `to`. `poses` are those of the photos in the world of `space`, `world` the way from there to
    /// the capture's. The Gaussians are in the capture's world.
    fn phase(
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
        let budget = match self.asked.steps {
            Some(steps) => Budget::Steps(((to - from) * steps as f64).round() as u64),
            None => Budget::Time(Duration::from_secs_f64((to - from) * self.seconds)),
        };
        let photos = Photos::new(self.photos, poses, self.config.levels());
        let task = Task { photos: &photos, depth, config: self.config, budget, seed: self.asked.seed };
        let (steps, seconds) = (self.done_steps, self.done_seconds);
        let mut marks = MARKS.iter().peekable();
        let mut failure = None;
        let gaussians = refine(space, corrections, &task, |at| {
            self.done_steps = steps + at.step;
            self.done_seconds = seconds + at.elapsed.as_secs_f64();
            self.bar.set_position(((from + (to - from) * at.progress) * 1000.) as u64);
            if marks.next_if(|&&mark| at.progress >= mark).is_some() {
                failure = self.mark(&in_world(at.gaussians())).err();
            }
            failure.is_none() && !self.stop.load(Ordering::Relaxed)
        })?;
        if let Some(error) = failure {
            return Err(error.into());
        }
        let gaussians = in_world(gaussians);
        self.mark(&gaussians)?;
        Ok(gaussians)
    }

    /// Scores the views held out.
    fn mark(&mut self, gaussians: &Gaussians) -> globalsplat::Result<()> {
        if let Some(scores) = self.judge.held_out_scores(gaussians)? {
            self.keep(&scores);
        }
        Ok(())
    }

    /// What views held out score now.
    fn keep(&mut self, scores: &CaptureScores) {
        self.bar.set_message(format!("{} steps, held out {:.2} dB", self.done_steps, scores.psnr));
        let (steps, seconds) = (self.done_steps, self.done_seconds);
        let &CaptureScores { psnr, ssim, lpips_vgg, .. } = scores;
        self.curve.push(Mark { seconds, steps, psnr, ssim, lpips_vgg });
    }
}

/// Scores splats of a capture.
struct Judge {
    name: String,
    held_out: Vec<View>,
    perceptual: Perceptual,
}

/// Of the photos shown, and of those held out, if any.
#[derive(Clone)]
struct Scores {
    shown: CaptureScores,
    held_out: Option<CaptureScores>,
}

impl Judge {
    fn scores_of_both(&self, gaussians: &Gaussians, shown: &[View]) -> globalsplat::Result<Scores> {
        Ok(Scores { shown: self.scores(gaussians, shown)?, held_out: self.held_out_scores(gaussians)? })
    }

    fn scores(&self, gaussians: &Gaussians, views: &[View]) -> globalsplat::Result<CaptureScores> {
        let pictures: Vec<_> = rendered(gaussians, views)?.into_iter().map(|rendered| rendered.rgb).collect();
        judge_pictures(&self.name, &pictures, views, Some(gaussians.count()), &self.perceptual)
    }

    fn held_out_scores(&self, gaussians: &Gaussians) -> globalsplat::Result<Option<CaptureScores>> {
        (!self.held_out.is_empty()).then(|| self.scores(gaussians, &self.held_out)).transpose()
    }
}

/// What was learned of the photos, in one line, if anything was.
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

fn means(scores: &CaptureScores) -> Value {
    json!({ "psnr": scores.psnr, "ssim": scores.ssim, "lpips_vgg": scores.lpips_vgg })
}

fn rendered(gaussians: &Gaussians, views: &[View]) -> globalsplat::Result<Vec<Rendered>> {
    let cameras: Vec<_> = views.iter().map(|view| view.camera).collect();
    render_views(gaussians, &cameras)
}
