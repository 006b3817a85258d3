//! The command `refine`: its arguments, and the work that `reconstruct --refine` shares with it.

mod job;
mod report;

pub use job::{InitialFile, RefineJob, Reports};

use super::capture::SceneSource;
use super::{check_former_option, check_views, device, parse_holdout, parse_photo_size};
use anyhow::Result;
use clap::{Args, ValueEnum};
use globalsplat::data::Holdout;
use globalsplat::error::Error;
use globalsplat::refine::{Budget, ExposureCorrection, MaskBackground, RefineConfig, RefineOptions};
use std::path::PathBuf;

/// Maximum of `--gaussians`.
const MAX_GAUSSIANS: usize = 10_000_000;

/// Optimize a splat on the photos of its scene, or create one from the photos alone.
///
/// The Gaussians are optimized until their renders match the photos. Without --splat they are initialized where the depths of
/// several photos agree, and their number grows to --gaussians; neither weights nor a GPU are needed. Ctrl-C ends the
/// optimization early and writes the current splat.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat refine --scene captures/room --out room.ply\n  \
    globalsplat refine --photos photos/room --out room.ply\n  \
    globalsplat refine --splat room.ply --scene captures/room --out better.ply --seconds 30\n  \
    globalsplat refine --scene captures/room --holdout every:8 --sheet views.png --out room.ply\n  \
    globalsplat refine --scene captures/room --gaussians 100000 --seconds 240 --out room.ply")]
pub struct Refine {
    /// Initial splat, in the capture's world coordinates, in any format that `convert` reads
    #[arg(long, value_name = "FILE", conflicts_with = "gaussians")]
    splat: Option<PathBuf>,
    /// Initialization without --splat: from the photos alone, or from a model's reconstruction
    #[arg(long, value_enum, conflicts_with = "splat")]
    from: Option<From>,
    /// Weights of the initial model, as `globalsplat export` writes them; by default the weights embedded in this program
    #[arg(long, value_name = "FILE", conflicts_with = "splat")]
    weights: Option<PathBuf>,
    /// Former option. Its other values than `gaussians` are refused
    #[arg(long, hide = true)]
    space: Option<String>,
    #[command(flatten)]
    scene: SceneSource,
    /// Folder of masks named like the photos, as in photo.jpg.png or photo.png: black pixels are ignored; by default the masks and
    /// transparency of the capture itself
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,
    /// Background of masked pixels instead of ignoring them, so that the splat stays empty there
    #[arg(long, value_enum, value_name = "COLOUR")]
    mask_background: Option<Background>,
    /// Output splat: .ply, .compressed.ply, .sog, meta.json, .spz, .splat, .glb or .gltf
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Write the state of the optimization beside the splat, as in room.state.safetensors, and continue from it if it is there:
    /// --seconds and --steps include those of the earlier runs
    #[arg(long)]
    resume: bool,
    /// Write coordinates relative to the centre of the cameras, which is stored in a file beside the splat: far from the
    /// world's origin, as in UTM coordinates, float32 loses detail
    #[arg(long)]
    local_origin: bool,
    /// Number of Gaussians, not allowed with --splat. auto: 16384 to 1000000, by --seconds, the number of cores and the photos; 16384
    /// with --steps
    #[arg(long, value_name = "N|auto", default_value = "auto", value_parser = parse_gaussians)]
    gaussians: GaussianCount,
    /// Total time in seconds, from the start of the program to its end
    #[arg(long, value_name = "S", default_value_t = 60., conflicts_with = "steps")]
    seconds: f64,
    /// Number of steps, instead of a time: the same steps and seed give the same bytes
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Seed of the random numbers
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// Views to hold out and score: every:N, every:N+K, or none for only the capture's own test split
    #[arg(long, value_name = "WHICH", default_value = "none")]
    holdout: String,
    /// Maximum number of the other views, spread along the camera path; by default as many as fit into about 2 GB of memory
    #[arg(long, value_name = "N")]
    views: Option<usize>,
    /// Size of the photos: the longer side to which larger ones are downscaled, as in 1600, or WxH, to which all are cropped and
    /// resized; by default 512, with more than 25,000 Gaussians 1024, and with more than 250,000 1600
    #[arg(long, value_name = "N|WxH")]
    size: Option<String>,
    /// Also optimize a correction of each camera's pose
    #[arg(long)]
    correct_poses: bool,
    /// Also optimize a gain of red, green and blue for each photo. auto: if the exposures of neighbouring photos differ, which is
    /// measured together with depths, never with --splat; without a value: on
    #[arg(
        long,
        value_name = "WHEN",
        default_value = "auto",
        default_missing_value = "on",
        num_args = 0..=1,
        require_equals = true
    )]
    correct_exposures: WhenToCorrect,
    /// Optimize the splat for antialiased rendering, which looks right at smaller sizes and from afar, too. The file is marked, and
    /// viewers have to support it: others show the splat slightly worse
    #[arg(long)]
    antialiased: bool,
    #[command(flatten)]
    reports: Reports,
    /// Override a setting of the method, as in views=4; docs/refine.md lists them
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Device of the optimization: cpu, cuda or cuda:N
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    device: String,
    /// Print the result as one JSON object
    #[arg(long)]
    json: bool,
}

/// Initialization of the optimization.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum From {
    /// Pixels at which the depths of the photos agree
    Nothing,
    /// A model's reconstruction, and pixels for the Gaussians that it lacks to --gaussians
    Weights,
}

/// Condition for the correction of exposures.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum WhenToCorrect {
    /// Never
    Off,
    /// If the exposures of neighbouring photos differ
    Auto,
    /// Always
    On,
}

/// Background of masked pixels.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Background {
    /// Black
    Black,
    /// White
    White,
    /// Another colour in every step
    Random,
}

impl Refine {
    pub fn run(self) -> Result<()> {
        check_views(self.views)?;
        let holdout = parse_holdout(&self.holdout)?;
        let options = self.options(holdout)?;
        let needs_model = self.needs_model()?;
        let why =
            "tokens and both were removed, as they gained nothing over gaussians: see docs/experiments.md";
        check_former_option("--space", self.space.as_deref(), "gaussians", why)?;
        let initial = match self.splat {
            Some(splat) => InitialFile::Splat(splat),
            None if needs_model => InitialFile::Model(self.weights),
            None => InitialFile::Photos,
        };
        let size = self.size.as_deref().map(parse_photo_size).transpose()?;
        let GaussianCount(gaussians) = self.gaussians;
        let Refine { scene, masks, out, resume, local_origin, reports, json, .. } = self;
        RefineJob {
            scene,
            masks,
            out,
            initial,
            options,
            gaussians,
            size,
            resume,
            local_origin,
            reports,
            json,
        }
        .run()
    }

    fn needs_model(&self) -> Result<bool> {
        if self.from == Some(From::Nothing) && self.weights.is_some() {
            let why = "--from nothing uses no weights; --from weights does";
            return Err(Error::request(why).into());
        }
        Ok(self.weights.is_some() || self.from == Some(From::Weights))
    }

    fn options(&self, holdout: Holdout) -> Result<RefineOptions> {
        let default = RefineOptions::default();
        let time = parse_time(self.seconds)?;
        let mut config = RefineConfig::with(&self.set, self.splat.is_some())?;
        config.antialiased |= self.antialiased;
        Ok(RefineOptions {
            config,
            budget: self.steps.map_or(time, Budget::Steps),
            seed: self.seed,
            holdout,
            views: self.views,
            correct_poses: self.correct_poses,
            correct_exposures: match self.correct_exposures {
                WhenToCorrect::Off => ExposureCorrection::Off,
                WhenToCorrect::Auto => ExposureCorrection::Auto,
                WhenToCorrect::On => ExposureCorrection::On,
            },
            mask_background: self.mask_background.map(|background| match background {
                Background::Black => MaskBackground::Black,
                Background::White => MaskBackground::White,
                Background::Random => MaskBackground::Random,
            }),
            device: device::parse(&self.device)?,
            ..default
        })
    }
}

/// Number of Gaussians, or `None` to choose it.
#[derive(Debug, Clone, Copy)]
struct GaussianCount(Option<usize>);

fn parse_gaussians(text: &str) -> Result<GaussianCount, String> {
    match text.parse() {
        _ if text == "auto" => Ok(GaussianCount(None)),
        Ok(count) if (1..=MAX_GAUSSIANS).contains(&count) => Ok(GaussianCount(Some(count))),
        _ => Err(format!("expected 1 to {MAX_GAUSSIANS}, or auto")),
    }
}

/// Checks a time in seconds and returns it as a budget.
pub fn parse_time(seconds: f64) -> Result<Budget> {
    let invalid = || Error::request(format!("--seconds is {seconds}, expected more than 0, up to a year"));
    Ok(Budget::from_seconds(seconds).ok_or_else(invalid)?)
}
