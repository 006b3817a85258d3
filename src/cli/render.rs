use super::{model, parse_size, print_json, progress};
use anyhow::Result;
use clap::{ArgGroup, Args};
use glam::{DMat4, DVec3};
use globalsplat::data::{Capture, Holdout, open_capture, read_camera_path};
use globalsplat::error::Error;
use globalsplat::io::{
    Splat, check_writable_dir, check_writable_file, colourize_depth, read_splat, tile_horizontally,
    write_film, write_png,
};
use globalsplat::reconstruct::{load_context, reconstruct};
use globalsplat::render::{Rendered, render_views};
use globalsplat::scene::{Camera, ImageSize, Intrinsics, orbit_around_cameras, orbit_around_point};
use serde_json::json;
use std::path::PathBuf;
use tch::{Device, Kind, Tensor};

const FRAMES_PER_SECOND: u32 = 20;
/// Of an orbit.
const DEFAULT_FRAMES: usize = 60;
/// Of a picture when no capture tells one.
const DEFAULT_SIZE: u32 = 512;

/// Render a splat, or what a model makes of a capture's photos, from the capture's cameras, along a path, or on an orbit.
///
/// Colour always; --depth and --alpha add those, side by side in a film and as files of their own in a folder.
#[derive(Args)]
#[command(group(ArgGroup::new("source").required(true)))]
#[command(group(ArgGroup::new("cameras").required(true).multiple(true)))]
#[command(
    after_help = "Examples:\n  globalsplat render --splat room.ply --scene captures/room --out views/\n  \
    globalsplat render --splat room.ply --scene captures/room --orbit --out orbit.gif\n  \
    globalsplat render --weights model.ckpt --scene captures/room --orbit --out orbit.gif"
)]
pub struct Render {
    /// A splat: .ply, .compressed.ply, .spz or .splat
    #[arg(long, value_name = "FILE", group = "source")]
    splat: Option<PathBuf>,
    /// What a model makes of the capture's photos, as `reconstruct` does: what `export` or `import` wrote, or a checkpoint (.ckpt)
    #[arg(long, value_name = "FILE", group = "source", requires = "scene")]
    weights: Option<PathBuf>,
    /// Cameras of this capture; with --orbit, an orbit amid them
    #[arg(long, value_name = "PATH", group = "cameras")]
    scene: Option<PathBuf>,
    /// An orbit, around the splat when no capture is named
    #[arg(long, group = "cameras")]
    orbit: bool,
    /// Cameras of this capture, of any format, whose photos need not exist, or of a camera_path.json of nerfstudio's viewer
    #[arg(long, value_name = "PATH", group = "cameras", conflicts_with_all = ["scene", "orbit"])]
    path: Option<PathBuf>,
    /// A folder for a PNG per camera, or a film: .gif, .mp4 (by ffmpeg); or a .png of all side by side
    #[arg(long, value_name = "DIR|FILE")]
    out: PathBuf,
    /// Also depth, near bright and far dark
    #[arg(long)]
    depth: bool,
    /// Also accumulated opacity
    #[arg(long)]
    alpha: bool,
    /// Frames of an orbit; by default 60
    #[arg(long, value_name = "N", requires = "orbit")]
    frames: Option<usize>,
    /// Picture size, as in 640x480; by default the capture's
    #[arg(long, value_name = "WxH")]
    size: Option<String>,
    /// Print what was written as one JSON object
    #[arg(long)]
    json: bool,
}

impl Render {
    pub fn run(self) -> Result<()> {
        let ending = self.out.extension().and_then(|e| e.to_str()).unwrap_or_default();
        let film = matches!(ending, "gif" | "mp4" | "png");
        if film {
            check_writable_file(&self.out)?
        } else {
            check_writable_dir(&self.out)?
        }
        let capture = self.scene.as_deref().map(open_capture).transpose()?;
        let splat = self.splat(capture.as_ref())?;
        let (names, cameras) = self.cameras(&splat, capture.as_ref())?;

        let bar = progress::bar(cameras.len() as u64, "views");
        let mut written = vec![];
        let mut pictures = vec![];
        for (name, camera) in names.iter().zip(&cameras) {
            let rendered = render_views(&splat.gaussians, std::slice::from_ref(camera))?.remove(0);
            let parts = self.parts(&rendered);
            if film {
                let pictures_of_view: Vec<Tensor> = parts.into_iter().map(|(_, picture)| picture).collect();
                pictures.push(tile_horizontally(&pictures_of_view));
            } else {
                for (suffix, picture) in parts {
                    let file = self.out.join(format!("{name}{suffix}.png"));
                    let folder = file.parent().expect("it is in the output");
                    std::fs::create_dir_all(folder).map_err(Error::write(folder))?;
                    if capture.as_ref().is_some_and(|capture| capture.has_photo(&file)) {
                        let expected = "a folder without the capture's photos";
                        return Err(
                            Error::input(&file, "the output", "a photo of the capture", expected).into()
                        );
                    }
                    write_png(&file, &picture)?;
                    written.push(file);
                }
            }
            bar.inc(1);
        }
        if film {
            match ending {
                "png" => write_png(&self.out, &tile_horizontally(&pictures))?,
                _ => write_film(&self.out, &pictures, FRAMES_PER_SECOND)?,
            }
            written.push(self.out.clone());
        }
        bar.finish_and_clear();
        if self.json {
            print_json(
                &json!({ "views": cameras.len(), "gaussians": splat.gaussians.count(), "files": written }),
            );
        } else {
            println!("{}: {} views", self.out.display(), cameras.len());
        }
        Ok(())
    }

    fn splat(&self, capture: Option<&Capture>) -> Result<Splat> {
        let (Some(weights), Some(capture)) = (&self.weights, capture) else {
            return Ok(read_splat(self.splat.as_ref().expect("clap asks for one of the two"))?);
        };
        let loaded = model::load(Some(weights), "f32", Device::Cpu)?;
        let data = &loaded.config.data;
        let photos = load_context(capture, Holdout::None, Some(data.context_views), data.image_size)?;
        Ok(Splat::of(&reconstruct(&loaded, &photos, &[])?.in_world())?)
    }

    /// Colour and what else was asked for, [3, H, W], each with its file's suffix.
    fn parts(&self, rendered: &Rendered) -> Vec<(&'static str, Tensor)> {
        let mut parts = vec![("", rendered.rgb.clamp(0., 1.))];
        if self.depth {
            parts.push(("_depth", colourize_depth(&rendered.depth, &rendered.alpha)));
        }
        if self.alpha {
            parts.push(("_alpha", rendered.alpha.unsqueeze(0).expand([3, -1, -1], false)));
        }
        parts
    }

    /// What pictures are called, and their cameras.
    fn cameras(&self, splat: &Splat, capture: Option<&Capture>) -> Result<(Vec<String>, Vec<Camera>)> {
        let size = self.size.as_deref().map(parse_size).transpose()?;
        let resized = |cameras: Vec<Camera>| -> Vec<Camera> {
            match size {
                Some(size) => cameras.iter().map(|camera| with_size(camera, size)).collect(),
                None => cameras,
            }
        };
        let numbered = |cameras: &[Camera]| (0..cameras.len()).map(|i| format!("{i:03}")).collect();
        if let Some(path) = &self.path {
            let cameras = resized(read_camera_path(path, size)?.cameras);
            return Ok((numbered(&cameras), cameras));
        }
        let frames = self.frames.unwrap_or(DEFAULT_FRAMES);
        if frames == 0 {
            return Err(Error::Request("--frames is 0, expected 1 or more".into()).into());
        }
        let Some(capture) = capture else {
            let size = size.unwrap_or(ImageSize { width: DEFAULT_SIZE, height: DEFAULT_SIZE });
            let cameras = orbit_around_splat(splat, size, frames);
            return Ok((numbered(&cameras), cameras));
        };
        let cameras = resized(capture.cameras());
        if self.orbit {
            let distance = median_depth(splat, &cameras)?;
            let cameras = orbit_around_cameras(&cameras, distance, frames)?;
            return Ok((numbered(&cameras), cameras));
        }
        Ok((capture.picture_names(), cameras))
    }
}

/// The same view in a picture of another size: as much to see along the shorter side.
fn with_size(camera: &Camera, ImageSize { width, height }: ImageSize) -> Camera {
    let (x, y) = (f64::from(width) / f64::from(camera.width), f64::from(height) / f64::from(camera.height));
    let factor = x.min(y);
    let k = camera.intrinsics;
    let intrinsics = Intrinsics { fx: k.fx * factor, fy: k.fy * factor, cx: k.cx * x, cy: k.cy * y };
    Camera { intrinsics, c2w: camera.c2w, width, height }
}

/// What a camera in the middle of the capture sees at its centre, half of the pixels being nearer.
fn median_depth(splat: &Splat, cameras: &[Camera]) -> Result<f64> {
    let rendered = render_views(&splat.gaussians, &cameras[cameras.len() / 2..][..1])?.remove(0);
    let seen = rendered.depth.masked_select(&rendered.alpha.ge(0.5));
    Ok(if seen.numel() == 0 { 1. } else { seen.median().double_value(&[]) })
}

/// Around the middle of the splat's opaque part, far enough to see most of it.
pub(super) fn orbit_around_splat(
    splat: &Splat,
    ImageSize { width, height }: ImageSize,
    frames: usize,
) -> Vec<Camera> {
    let g = &splat.gaussians;
    let means = g.means.view([-1, 3]).to_kind(Kind::Double);
    let weights = g.opacities.view([-1, 1]).to_kind(Kind::Double);
    let total = weights.sum(Kind::Double).clamp_min(1e-12);
    let centre = (&means * &weights).sum_dim_intlist([0i64].as_slice(), false, Kind::Double) / &total;
    let spread = ((&means - &centre).square().sum_dim_intlist([1i64].as_slice(), true, Kind::Double)
        * &weights)
        .sum(Kind::Double)
        .divide(&total)
        .sqrt()
        .double_value(&[]);
    let centre = DVec3::new(centre.double_value(&[0]), centre.double_value(&[1]), centre.double_value(&[2]));
    let (w, h) = (f64::from(width), f64::from(height));
    let focal = w.min(h);
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: w / 2., cy: h / 2. };
    let reference = Camera { intrinsics, c2w: DMat4::IDENTITY, width, height };
    orbit_around_point(centre, 3. * spread.max(1e-6), &reference, frames)
}
