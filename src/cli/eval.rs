use super::{device, print_json};
use anyhow::Result;
use clap::{ArgGroup, Args};
use globalsplat::data::{Holdout, View, open_capture};
use globalsplat::eval::{
    CaptureScores, Perceptual, Rendered, contact_sheet, peak_memory_bytes, score_model, score_renders,
    score_splat,
};
use globalsplat::io::{check_writable_file, load_model, read_ply, write_png};
use std::path::PathBuf;
use tch::Tensor;

/// Score a model, a splat or pictures against a capture's photos: PSNR, SSIM, and LPIPS where `make weights` was run.
///
/// With --weights the model sees the views that are not held out and is asked for the others; with --splat or --renders
/// all views are asked for.
#[derive(Args)]
#[command(group(ArgGroup::new("subject").required(true)))]
#[command(after_help = "Examples:\n  globalsplat eval --splat scene.ply --scene captures/room --json\n  \
    globalsplat eval --weights model.safetensors --scene captures/room --holdout every:8 --sheet views.png")]
pub struct Eval {
    /// Weights that `globalsplat export` wrote
    #[arg(long, value_name = "FILE", group = "subject")]
    weights: Option<PathBuf>,
    /// A 3DGS splat in the capture's world
    #[arg(long, value_name = "FILE.ply", group = "subject")]
    splat: Option<PathBuf>,
    /// A folder of pictures named as the photos
    #[arg(long, value_name = "DIR", group = "subject")]
    renders: Option<PathBuf>,
    /// The capture: a folder with a cameras.json, a transforms.json or a COLMAP model
    #[arg(long, value_name = "PATH")]
    scene: PathBuf,
    /// Views the model is asked for: every:N or every:N+K; by default as it was trained
    #[arg(long, value_name = "WHICH", requires = "weights")]
    holdout: Option<String>,
    /// Also write a picture: photo, render and depth side by side, a row per view
    #[arg(long, value_name = "FILE.png", conflicts_with = "renders")]
    sheet: Option<PathBuf>,
    /// cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Print the scores as one JSON object
    #[arg(long)]
    json: bool,
}

impl Eval {
    pub fn run(self) -> Result<()> {
        let device = device::parse(&self.device)?;
        if let Some(sheet) = &self.sheet {
            check_writable_file(sheet)?;
        }
        let capture = open_capture(&self.scene)?;
        let (mut scores, views, pictures, rendered) = if let Some(path) = &self.splat {
            with_pictures(score_splat(&read_ply(path)?.gaussians, &capture)?)
        } else if let Some(path) = &self.weights {
            let loaded = load_model(path, device)?;
            let holdout = match &self.holdout {
                Some(text) => text.parse::<Holdout>().map_err(globalsplat::Error::Request)?,
                None => loaded.config.data.holdout,
            };
            with_pictures(score_model(&loaded, &capture, holdout)?)
        } else {
            let folder = self.renders.as_ref().expect("clap asks for one of the three");
            let (scores, views, pictures) = score_renders(folder, &capture)?;
            (scores, views, pictures, vec![])
        };
        let peak_memory = peak_memory_bytes(); // of the subject, not of the networks that judge it
        let perceptual = Perceptual::find(device)?;
        perceptual.add_to(&mut scores, &pictures, &views);
        if let Some(sheet) = &self.sheet {
            write_png(sheet, &contact_sheet(&views, &rendered))?;
        }
        if let Some(line) = perceptual.why_absent(&scores) {
            eprintln!("{line}");
        }
        if self.json {
            let mut object = serde_json::to_value(&scores)?;
            object["peak_memory_bytes"] = peak_memory.into();
            print_json(&object);
        } else {
            print_table(&scores);
        }
        Ok(())
    }
}

type Scored = (CaptureScores, Vec<View>, Vec<Rendered>);

fn with_pictures(
    (scores, views, rendered): Scored,
) -> (CaptureScores, Vec<View>, Vec<Tensor>, Vec<Rendered>) {
    let pictures = rendered.iter().map(|r| r.rgb.shallow_clone()).collect();
    (scores, views, pictures, rendered)
}

fn print_table(scores: &CaptureScores) {
    let gaussians = scores.gaussians.map_or(String::new(), |n| format!(", {n} Gaussians"));
    println!("{}: {} views{gaussians}", scores.scene, scores.views.len());
    // Columns that no view would fill are left out.
    let columns = [
        ("LPIPS-VGG", scores.views.iter().any(|view| view.lpips_vgg.is_some())),
        ("LPIPS-Alex", scores.views.iter().any(|view| view.lpips_alex.is_some())),
    ];
    let lpips = |values: [Option<f64>; 2]| -> String {
        let shown = columns.iter().zip(values).filter(|((_, filled), _)| *filled);
        shown
            .map(|(_, value)| format!(" {:>10}", value.map_or(String::new(), |v| format!("{v:.4}"))))
            .collect()
    };
    let names: String =
        columns.iter().filter(|(_, filled)| *filled).map(|(name, _)| format!(" {name:>10}")).collect();
    println!("{:<24} {:>8} {:>8}{names}", "view", "PSNR", "SSIM");
    for view in &scores.views {
        let lpips = lpips([view.lpips_vgg, view.lpips_alex]);
        println!("{:<24} {:>8.2} {:>8.4}{lpips}", view.image, view.psnr, view.ssim);
    }
    let lpips = lpips([scores.lpips_vgg, scores.lpips_alex]);
    println!("{:<24} {:>8.2} {:>8.4}{lpips}", "mean", scores.psnr, scores.ssim);
}
