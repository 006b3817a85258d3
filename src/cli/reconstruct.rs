use super::capture::{SceneSource, UprightOption};
use super::refine::{Refine, Reports};
use super::splat_out::{self, LocalOrigin};
use super::{Output, check_views, device, model, open_masked_capture, parse_holdout, signals};
use crate::data::Capture;
use crate::device::{Stopwatch, peak_memory_bytes, process_age};
use crate::io::{InputFiles, check_writable_splat, splat_files};
use crate::reconstruct::{load_context, reconstruct};
use crate::refine::RefineOptions;
use crate::scene::{ImageSize, LocalFrame};
use anyhow::Result;
use clap::Args;
use glam::DVec3;
use serde_json::{Map, Value, json};
use std::collections::BTreeSet;
use std::path::PathBuf;

/// Turn posed photos into a splat.
///
/// The splat is in the capture's own world coordinates, so a render from a camera of the capture matches its photo.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat reconstruct --scene captures/room --out room.ply\n  \
    globalsplat reconstruct --photos photos/room --out room.ply\n  \
    globalsplat reconstruct --weights model.safetensors --scene captures/room --out room.ply")]
pub struct Reconstruct {
    /// Weights: a file that `export` or `import` wrote, or a checkpoint (.ckpt); by default the weights embedded in this
    /// program
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    #[command(flatten)]
    scene: SceneSource,
    #[command(flatten)]
    upright: UprightOption,
    /// Folder of masks named like the photos, as in photo.jpg.png or photo.png: the model doesn't see black pixels; by default the
    /// masks and transparency of the capture itself
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,
    /// Output splat: .ply, .compressed.ply, .sog, meta.json, .spz, .splat, .glb or .gltf
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Maximum number of photos, spread along the camera path; by default the number that the weights were configured for, 24
    /// for the weights embedded in this program
    #[arg(long, value_name = "N")]
    views: Option<usize>,
    /// Held-out views: every:N, every:N+K, or none for only the capture's own test split
    #[arg(long, value_name = "WHICH", default_value = "none")]
    holdout: String,
    /// Also refine the splat on all input photos for this time, as `refine --init model` does; as in 60s or 2m
    #[arg(long, value_name = "TIME", value_parser = parse_seconds, conflicts_with = "precision")]
    refine: Option<f64>,
    #[command(flatten)]
    local_origin: LocalOrigin,
    /// Precision: f32, bf16 for matrix products, or auto: bf16 for wide models if the device has instructions for it
    #[arg(long, default_value = "auto")]
    precision: String,
    /// Device: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
}

impl Reconstruct {
    /// Reconstructs the same splat and then optimizes its Gaussians for `seconds`.
    fn run_refined(self, seconds: f64) -> Result<Output> {
        let options = RefineOptions {
            seconds,
            holdout: parse_holdout(&self.holdout)?,
            max_views: self.views,
            ..Default::default()
        };
        let Reconstruct { weights, scene, upright, masks, out, local_origin, device, .. } = self;
        Refine {
            splat: None,
            init: Some("model".into()),
            weights,
            scene,
            upright,
            masks,
            out,
            resume: false,
            ignore_verdict: false,
            local_origin,
            options,
            reports: Reports::default(),
            device,
        }
        .run()
    }

    pub fn run(self) -> Result<Output> {
        check_views(self.views)?;
        if let Some(seconds) = self.refine {
            return self.run_refined(seconds);
        }
        let device = device::parse(&self.device)?;
        let holdout = parse_holdout(&self.holdout)?;
        check_writable_splat(&self.out)?;
        self.local_origin.check(&self.out, None)?;
        let asked = model::parse_precision(&self.precision)?;
        let started = process_age();
        let mut stopwatch = Stopwatch::default();
        signals::handle_stop_requests();
        signals::end_at_request(1);
        let path = || self.scene.path(self.masks.as_deref(), self.upright, &self.out);
        let (scene, masks) = if self.scene.is_unposed() { stopwatch.time("poses", path)? } else { path()? };
        let loaded = stopwatch.time("weights", || model::load(self.weights.as_deref(), asked, device))?;
        let capture = stopwatch.time("photos", || open_masked_capture(&scene, masks))?;
        let mut inputs = InputFiles::default();
        capture.add_input_files(&mut inputs);
        self.weights.iter().for_each(|path| inputs.add(path));
        splat_files(&self.out).iter().try_for_each(|file| inputs.check_file(file))?;
        let data = &loaded.config.data;
        let count = self.views.unwrap_or(data.context_views);
        let photos =
            stopwatch.time("photos", || load_context(&capture, holdout, Some(count), data.image_size))?;
        if let Some(line) = fitting(&capture, photos.len(), data.image_size) {
            eprintln!("{line}");
        }
        let reconstruction = stopwatch.time("network", || reconstruct(&loaded, &photos, &[]))?;
        stopwatch.time("splat", || {
            let (splat, cameras) = (reconstruction.to_splat()?, capture.cameras());
            let center = || LocalFrame::from_cameras(&cameras).origin;
            splat_out::write_for(&self.out, &splat, &cameras, self.local_origin.choose(DVec3::ZERO, center))
        })?;
        let parts: Map<String, Value> = started
            .map(|age| ("start", age))
            .into_iter()
            .chain(stopwatch.sections()?.iter().copied())
            .map(|(name, time)| (name.into(), json!(time.as_secs_f64())))
            .collect();
        let from_start = process_age().map(|age| age.as_secs_f64());

        let bytes = std::fs::metadata(&self.out)?.len();
        let (count, seconds) = (reconstruction.gaussians.count(), reconstruction.forward_time.as_secs_f64());
        let (out, peak_memory) = (self.out.to_string_lossy(), peak_memory_bytes());
        let pass = match data.color_steps {
            0 => "forward pass",
            _ => "forward pass and fit of colors",
        };
        let text = format!(
            "{out}: {count} Gaussians from {} photos, {:.2} MB; {pass} {seconds:.2} s, peak memory {:.2} GB",
            photos.len(),
            bytes as f64 / 1e6,
            peak_memory as f64 / 1e9
        );
        let json = json!({
            "splat": out,
            "weights": model::name(self.weights.as_deref()).to_string_lossy(),
            "photos": photos.len(),
            "image_size": data.image_size,
            "gaussians": count,
            "precision": loaded.model.precision(),
            "load_seconds": parts["weights"],
            "seconds": seconds,
            "seconds_of": parts,
            "seconds_from_start": from_start,
            "peak_memory_bytes": peak_memory,
            "bytes": bytes,
            "transform": capture.upright(),
        });
        Ok(Output::new(json, text))
    }
}

/// Parses a time, `60`, `60s` or `2m`, and returns it in seconds.
fn parse_seconds(text: &str) -> Result<f64, String> {
    let (number, unit) = match text.strip_suffix('m') {
        Some(minutes) => (minutes, 60.),
        None => (text.strip_suffix('s').unwrap_or(text), 1.),
    };
    let seconds = number.parse::<f64>().ok().map(|number| number * unit);
    seconds.filter(|s| *s > 0. && s.is_finite()).ok_or_else(|| "expected a time, as in 60s or 2m".into())
}

/// Describes how the capture's photos are selected and resized before a model that was trained with images of `trained` gets
/// `shown` of them; `None` if they are used unchanged.
fn fitting(capture: &Capture, shown: usize, trained: ImageSize) -> Option<String> {
    let sizes: BTreeSet<(u32, u32)> = capture.cameras().iter().map(|c| (c.width, c.height)).collect();
    let chosen = (shown < capture.len())
        .then(|| format!("{shown} of {} photos are shown, spread over the camera's path", capture.len()));
    let model = format!("the {}×{} pixels that the model sees", trained.width, trained.height);
    let fitted = match sizes.first() {
        Some((width, height)) if sizes.len() == 1 => ((*width, *height) != (trained.width, trained.height))
            .then(|| format!("{width}×{height} pixels are cut and resized to {model}")),
        _ => Some(format!("photos of {} sizes are cut and resized to {model}", sizes.len())),
    };
    let parts: Vec<String> = chosen.into_iter().chain(fitted).collect();
    (!parts.is_empty()).then(|| format!("{}: {}", capture.name, parts.join("; ")))
}
