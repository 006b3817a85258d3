//! The command `render`: renders of a splat, or a page to explore it in.

mod output;
mod shots;

use super::{Output, model, open_capture, progress, signals, view, warn};
use crate::data::{Capture, Holdout};
use crate::error::Error;
use crate::io::{InputFiles, read_splat, splat_files, tiled_size};
use crate::model::Precision;
use crate::reconstruct::{load_context, reconstruct};
use crate::render::{DepthScale, RenderedView, SplatRenderer};
use crate::scene::{Camera, Gaussians, ImageSize};
use anyhow::Result;
use clap::{ArgGroup, Args};
use glam::DVec3;
use output::ImageOutput;
use serde_json::json;
use shots::Shots;
use std::path::{Path, PathBuf};
use tch::{Device, Tensor};

/// File name suffixes of images of depth and of alpha.
const DEPTH: &str = "_depth";
const ALPHA: &str = "_alpha";

/// Render a splat, or a model's reconstruction of a capture, from the capture's cameras, along a path, or on an orbit.
///
/// Color is always rendered; --depth and --alpha add those, side by side in a video and as files of their own in a folder.
#[derive(Args)]
#[command(group(ArgGroup::new("source").required(true)))]
#[command(group(ArgGroup::new("cameras").required(true).multiple(true)))]
#[command(
    after_help = "Examples:\n  globalsplat render --splat room.ply --scene captures/room --out views/\n  \
    globalsplat render --splat room.ply --scene captures/room --orbit --depth --out orbit.mp4\n  \
    globalsplat render --splat room.ply --scene captures/room --frames 200 --out smooth.mp4\n  \
    globalsplat render --splat room.ply --path camera_path.json --out flight.mp4\n  \
    globalsplat render --weights model.ckpt --scene captures/room --orbit --out orbit.gif\n  \
    globalsplat render --splat room.ply --scene captures/room --html room.html"
)]
pub struct Render {
    /// Splat: .ply, .compressed.ply, .sog, meta.json, .spz, .splat, .glb, .gltf, .ksplat or .zip
    #[arg(long, value_name = "FILE", group = "source")]
    splat: Option<PathBuf>,
    /// Weights to reconstruct the capture with, as `reconstruct` does: a file that `export` or `import` wrote, or a checkpoint
    /// (.ckpt)
    #[arg(long, value_name = "FILE", group = "source", requires = "scene")]
    weights: Option<PathBuf>,
    /// Capture whose cameras are used; with --orbit, an orbit around their mean, within their spread
    #[arg(long, value_name = "PATH", group = "cameras")]
    scene: Option<PathBuf>,
    /// Render an orbit, around the splat if no capture is given
    #[arg(long, group = "cameras")]
    orbit: bool,
    /// Camera path: a capture of any format, whose photos need not exist, or a camera_path.json of nerfstudio's viewer
    #[arg(long, value_name = "PATH", group = "cameras", conflicts_with_all = ["scene", "orbit"])]
    path: Option<PathBuf>,
    /// Output: a folder for a PNG per camera, or a video: .mp4 (by ffmpeg), .gif; or a .png of all images side by side,
    /// downscaled if it would have more than 64 million pixels
    #[arg(long, value_name = "DIR|FILE", required_unless_present = "html")]
    out: Option<PathBuf>,
    /// Write an interactive page instead, with the photos of --scene if there is one: a single file that needs no other file
    /// and no network
    #[arg(long, value_name = "FILE", group = "cameras",
        conflicts_with_all = ["out", "orbit", "path", "depth", "alpha", "frames", "fps", "size"])]
    html: Option<PathBuf>,
    /// Also render depth, near bright and far dark, on one scale for all images
    #[arg(long)]
    depth: bool,
    /// Also render accumulated opacity
    #[arg(long)]
    alpha: bool,
    /// Number of images: on a smooth path through the cameras, at constant speed, or on the orbit, which has 60 by default
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    frames: Option<u32>,
    /// Frames per second of a video; by default those of the path, else 20
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=120))]
    fps: Option<u32>,
    /// Image size, as in 640x480; by default the capture's
    #[arg(long, value_name = "WxH")]
    size: Option<String>,
}

impl Render {
    pub fn run(self) -> Result<Output> {
        match (&self.html, &self.out) {
            (Some(page), _) => self.page(page),
            (None, Some(out)) => self.pictures(out),
            (None, None) => unreachable!("clap asks for one of the two"),
        }
    }

    fn page(&self, page: &Path) -> Result<Output> {
        view::check_writable(Some(page))?;
        let capture = self.scene.as_deref().map(open_capture).transpose()?;
        self.inputs(capture.as_ref()).check_file(page)?;
        let (splat, origin) = self.gaussians(capture.as_ref())?;
        let name = capture.as_ref().map_or_else(|| view::name_of(page), |capture| capture.name.clone());
        view::write_page(page, &name, &splat, origin, capture.as_ref())?;
        let (gaussians, bytes) = (splat.count(), std::fs::metadata(page)?.len());
        let page = page.to_string_lossy();
        Ok(Output::new(
            json!({ "page": page, "gaussians": gaussians, "bytes": bytes }),
            format!("{page}: {gaussians} Gaussians, {:.1} MB", bytes as f64 * 1e-6),
        ))
    }

    fn pictures(&self, out: &Path) -> Result<Output> {
        ImageOutput::check(out, self.fps)?;
        let capture = self.scene.as_deref().map(open_capture).transpose()?;
        let (gaussians, origin) = self.gaussians(capture.as_ref())?;
        let renderer = SplatRenderer::from_gaussians(&gaussians, origin);
        let shots = Shots::new(self, capture.as_ref(), (&gaussians, origin), &renderer)?;
        let scale = if self.depth { Some(DepthScale::estimate(&renderer, &shots.cameras)?) } else { None };

        signals::handle_stop_requests();
        let mut inputs = self.inputs(capture.as_ref());
        inputs.extend(shots.inputs.clone());
        let film = (self.size_of_all(&shots.cameras), shots.frames_per_second);
        let mut output = ImageOutput::begin(out, (&shots.names, &self.suffixes()), film, &inputs)?;
        let bar = progress::bar(shots.cameras.len() as u64, "views");
        for camera in &shots.cameras {
            let rendered = renderer.render(std::slice::from_ref(camera))?.remove(0);
            output.add(&self.parts(&rendered, scale))?;
            if signals::is_stop_requested() {
                let (done, of, out) = (bar.position() + 1, shots.cameras.len(), out.display());
                return Err(Error::failed(format!("{out}: stopped after {done} of {of} views")).into());
            }
            bar.inc(1);
        }
        let written = output.finish()?;
        bar.finish_and_clear();
        let (views, out) = (shots.cameras.len(), out.display());
        let written: Vec<_> = written.iter().map(|file| file.to_string_lossy()).collect();
        Ok(Output::new(
            json!({ "views": views, "gaussians": gaussians.count(), "files": written }),
            format!("{out}: {views} views"),
        ))
    }

    /// Returns the Gaussians, and the origin of their means in the world.
    fn gaussians(&self, capture: Option<&Capture>) -> Result<(Gaussians, DVec3)> {
        let (Some(weights), Some(capture)) = (&self.weights, capture) else {
            let splat = read_splat(self.splat.as_ref().expect("clap asks for one of the two"))?;
            warn(&splat.warnings);
            return Ok((Gaussians::from_splat(&splat), splat.origin));
        };
        let loaded = model::load(Some(weights), Some(Precision::F32), Device::Cpu)?;
        let data = &loaded.config.data;
        let photos = load_context(capture, Holdout::None, Some(data.context_views), data.image_size)?;
        Ok(reconstruct(&loaded, &photos, &[])?.in_world_about_origin())
    }

    /// Returns the input files, which no output may replace.
    fn inputs(&self, capture: Option<&Capture>) -> InputFiles {
        let mut inputs = InputFiles::default();
        self.weights.iter().for_each(|path| inputs.add(path));
        self.splat.iter().for_each(|splat| inputs.add_all(splat_files(splat)));
        capture.inspect(|capture| capture.add_input_files(&mut inputs));
        inputs
    }

    /// Returns the file name suffixes of a camera's images.
    fn suffixes(&self) -> Vec<&'static str> {
        let depth = self.depth.then_some(DEPTH);
        [""].into_iter().chain(depth).chain(self.alpha.then_some(ALPHA)).collect()
    }

    /// Returns color and the other requested images, [3, H, W] each, in the order of the suffixes.
    fn parts(&self, rendered: &RenderedView, scale: Option<DepthScale>) -> Vec<Tensor> {
        let mut parts = vec![rendered.rgb.clamp(0., 1.)];
        if let Some(scale) = scale {
            parts.push(scale.colorize(&rendered.depth, &rendered.alpha));
        }
        if self.alpha {
            parts.push(rendered.alpha.unsqueeze(0).expand([3, -1, -1], false));
        }
        parts
    }

    /// Returns the size of the largest frame, with its parts side by side.
    fn size_of_all(&self, cameras: &[Camera]) -> ImageSize {
        let largest = |side: fn(&Camera) -> u32| cameras.iter().map(side).max().unwrap_or(0);
        let size =
            ImageSize { width: largest(|camera| camera.width), height: largest(|camera| camera.height) };
        tiled_size(size, 1 + u32::from(self.depth) + u32::from(self.alpha))
    }
}
