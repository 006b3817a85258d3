use super::{
    Output, check_views, device, distributed, model, open_masked_capture, parse_holdout, progress,
    report_downscaling, signals, warn, warn_of_many,
};
use crate::data::{Dataset, PhotoSize, Split};
use crate::error::Error;
use crate::eval::{
    DatasetEvaluation, EvalScene, Evaluation, EvaluationIndex, Method, REPORT, dataset_name,
    weights_fingerprint, write_evaluation, write_report,
};
use crate::io::{InputFiles, check_writable_dir, check_writable_png};
use crate::metrics::{CaptureScores, ContactSheet, Perceptual, Scores};
use crate::model::Precision;
use crate::reconstruct::{LoadedModel, Model};
use anyhow::Result;
use clap::{ArgGroup, Args};
use serde_json::json;
use std::path::{Path, PathBuf};
use tch::Device;

/// Evaluate a model, splats or images against photos: PSNR, SSIM, and LPIPS if `make weights` was run.
///
/// One capture (--scene): with --weights the input views of the model are those that are not held out, and the others are its
/// targets; with --splat or --renders all views are targets.
///
/// A dataset (--data, --index, --out), by the paper's protocol: every scene's context frames are the input and its target
/// frames are scored. DIR gets report.html, scores.json, scores.csv and the scores of every scene as soon as they are computed;
/// the same command resumes an interrupted evaluation, and scores changed splats and images again; `report` shows several
/// evaluations. Splats from other methods are DIR/SCENE.ply, or .spz and the like, images from other methods DIR/SCENE/000012.png,
/// named by the frame. Started by torchrun, several processes share the scenes: docs/distributed.md.
#[derive(Args)]
#[command(group(ArgGroup::new("subject").required(true)))]
#[command(group(ArgGroup::new("photos").required(true)))]
#[command(after_help = "Examples:\n  globalsplat eval --splat scene.ply --scene captures/room --json\n  \
    globalsplat eval --weights model.safetensors --scene captures/room --holdout every:8 --contact-sheet views.png\n  \
    globalsplat eval --weights model.safetensors --data re10k --index re10k_24v.json --out results/re10k")]
pub struct Eval {
    /// Weights: a file that `export` or `import` wrote, or a checkpoint (.ckpt)
    #[arg(long, value_name = "FILE", group = "subject")]
    weights: Option<PathBuf>,
    /// Splat in the capture's world coordinates, in any format that `convert` reads; with --data a folder of splats
    #[arg(long, value_name = "FILE|DIR", group = "subject")]
    splat: Option<PathBuf>,
    /// Folder of images named like the photos; with --data a folder of such folders
    #[arg(long, value_name = "DIR", group = "subject")]
    renders: Option<PathBuf>,
    /// Capture: a folder with a cameras.json, a transforms.json or a COLMAP model, or CHUNK.torch#KEY
    #[arg(long, value_name = "PATH", group = "photos")]
    scene: Option<PathBuf>,
    /// Folder of masks named like the photos, as in photo.jpg.png or photo.png: black pixels are not scored, nor seen by a model; by
    /// default the masks and transparency of the capture itself
    #[arg(long, value_name = "DIR", conflicts_with = "data")]
    masks: Option<PathBuf>,
    /// Dataset: a folder of chunks with an index.json, one with such a folder named test, or one of captures
    #[arg(long, value_name = "ROOT", group = "photos", requires_all = ["index", "out"])]
    data: Option<PathBuf>,
    /// Context and target frames of the dataset's scenes
    #[arg(long, value_name = "FILE.json", requires = "data", conflicts_with = "scene")]
    index: Option<PathBuf>,
    /// Folder for the report and the scores
    #[arg(long, value_name = "DIR", requires = "data", conflicts_with = "scene")]
    out: Option<PathBuf>,
    /// Name of the method in the report; by default the name of its file or folder
    #[arg(long, requires = "data", conflicts_with = "scene")]
    name: Option<String>,
    /// Name of the dataset in the report; by default re10k, acid or dl3dv, if its folder or the index has one of these names as
    /// a whole word, else the name of its folder
    #[arg(long, value_name = "NAME", requires = "data", conflicts_with = "scene")]
    dataset: Option<String>,
    /// Target views: every:N, every:N+K, or none for the capture's own test split; by default as in the model's training, and for
    /// splats and images all
    #[arg(long, value_name = "WHICH", conflicts_with = "data")]
    holdout: Option<String>,
    /// Number of input photos, spread along the camera path; by default all that are not held out
    #[arg(long, value_name = "N", conflicts_with_all = ["splat", "renders", "data"])]
    views: Option<usize>,
    /// Size of the scored images, to which photos are cropped and resized: WxH, or on one capture their longer side, as in 1600; by default
    /// that of the model's images, and for images from other methods 256x256 on a dataset and the photos' own on one capture
    #[arg(long, value_name = "N|WxH")]
    size: Option<String>,
    /// Also write an image: photo, render and depth side by side, a row per view; downscaled if it would have more than 64
    /// million pixels
    #[arg(long = "contact-sheet", value_name = "FILE.png", conflicts_with_all = ["renders", "data"])]
    sheet: Option<PathBuf>,
    /// Precision: f32, bf16 for the model's matrix products, or auto: bf16 for wide models if the device has instructions for
    /// it
    #[arg(long, default_value = "auto", conflicts_with_all = ["splat", "renders"])]
    precision: String,
    /// Device: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
}

impl Eval {
    pub fn run(self) -> Result<Output> {
        check_views(self.views)?;
        match &self.scene {
            Some(scene) => self.run_scene(scene, device::parse(&self.device)?),
            None => self.run_dataset(),
        }
    }

    fn run_scene(&self, scene: &Path, device: Device) -> Result<Output> {
        let capture = open_masked_capture(scene, self.masks.as_deref())?;
        if let Some(sheet) = &self.sheet {
            check_writable_png(sheet)?;
            let mut inputs = InputFiles::default();
            self.weights.iter().for_each(|weights| inputs.add(weights));
            self.method(None).add_input_files(&mut inputs);
            capture.add_input_files(&mut inputs);
            inputs.check_file(sheet)?;
        }
        let loaded = self.load_model(device)?;
        let model = loaded.as_ref().map(Model::from);
        let holdout = self.holdout.as_deref().map(parse_holdout).transpose()?;
        let scene = match model {
            Some(Model { config, .. }) => {
                let (holdout, photo_size) = (holdout.unwrap_or(config.data.holdout), config.data.image_size);
                let target_size = self.size()?.unwrap_or(PhotoSize::Exactly(photo_size));
                EvalScene::held_out(&capture, holdout, self.views, photo_size, target_size)?
            }
            None => EvalScene::without_context(&capture, holdout, self.size()?.unwrap_or(PhotoSize::Own))?,
        };
        let mut sheet = self.sheet.as_ref().map(|_| ContactSheet::new(scene.frames.target.len()));
        let perceptual = Perceptual::new(device);
        let scores =
            self.method(model).score(&scene, device, Some(&perceptual), |view, _, rendered, _| {
                let row = sheet.as_mut().zip(rendered);
                row.map_or(Ok(()), |(sheet, rendered)| sheet.add(&view.image.to_float(), rendered))
            })?;
        warn(&scores.warnings);
        // For a model, also score a trivial baseline that uses only the input photos.
        let nearest = model.map(|_| scene.score_nearest_photo()).transpose()?.map(|nearest| nearest.mean);
        if let Some((path, sheet)) = self.sheet.as_ref().zip(sheet) {
            report_downscaling(path, sheet.write(path)?);
        }
        if let Some(line) = Perceptual::explain_missing(&scores.scores.mean) {
            eprintln!("{line}");
        }
        let mut json = serde_json::to_value(&scores)?;
        let mut lines = table(&scores.scores);
        if let Some((Model { config, .. }, nearest)) = model.zip(nearest) {
            json["input"] = json!({ "photos": scene.context.len(), "image_size": config.data.image_size });
            json["baselines"] = json!({ "nearest_photo": nearest });
            let name = "the nearest photo shown";
            lines.push(format!("{name:<24} {:>8.2} {:>8.4}", nearest.psnr, nearest.ssim));
        }
        Ok(Output::new(json, lines.join("\n")))
    }

    /// Returns the size of the scored images, if it is given.
    fn size(&self) -> Result<Option<PhotoSize>> {
        let parse = |text: &String| {
            text.parse().map_err(|expected| Error::request(format!("--size {text}: {expected}")))
        };
        Ok(self.size.as_ref().map(parse).transpose()?)
    }

    fn load_model(&self, device: Device) -> Result<Option<LoadedModel>> {
        let requested = model::parse_precision(&self.precision)?;
        let load = |path: &PathBuf| model::load(Some(path), requested, device);
        Ok(self.weights.as_ref().map(load).transpose()?)
    }

    /// Returns the file or folder that is evaluated.
    fn path(&self) -> &Path {
        let paths = [&self.weights, &self.splat, &self.renders];
        paths.into_iter().flatten().next().expect("clap asks for one of the three")
    }

    fn method<'a>(&self, model: Option<Model<'a>>) -> Method<'a> {
        match (model, &self.splat) {
            (Some(model), _) => Method::Model(model),
            (None, Some(_)) => Method::Splat(self.path().to_owned()),
            (None, None) => Method::Renders(self.path().to_owned()),
        }
    }
}

/// Evaluation of a dataset.
impl Eval {
    fn run_dataset(&self) -> Result<Output> {
        let (group, device) = distributed::join(&self.device)?;
        let (Some(data), Some(index), Some(out)) = (&self.data, &self.index, &self.out) else {
            unreachable!("clap asks for all three")
        };
        let index = EvaluationIndex::read(index)?;
        if let Some(path) = self.splat.as_ref().or(self.renders.as_ref()).filter(|path| !path.is_dir()) {
            let expected = "a folder with those of every scene, for --data";
            return Err(Error::input(path, "what is to be scored", "no folder", expected).into());
        }
        let dataset = Dataset::open(data, Split::Test)?;
        warn_of_many(dataset.warnings().iter());
        check_writable_dir(out)?;
        let (loaded, path) = (self.load_model(device)?, self.path());
        let model = loaded.as_ref().map(Model::from);
        let target_size = match self.size()? {
            Some(PhotoSize::Exactly(size)) => size,
            Some(_) => {
                let size = self.size.as_deref().unwrap_or_default();
                return Err(Error::request(format!("--size {size}: expected WxH for a dataset")).into());
            }
            None => model.map_or(PROTOCOL_SIZE.into(), |model| model.config.data.image_size),
        };
        let precision = match model.map(|model| model.network.precision()) {
            Some(Precision::Bf16) => " bf16",
            _ => "",
        };
        let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        signals::handle_stop_requests()?;
        let bar = progress::bar(0, "scenes");
        let evaluation = DatasetEvaluation {
            method: self.method(model),
            name: self.name.clone().unwrap_or(stem + precision),
            // Splats and images are compared scene by scene, so the path of their folder identifies them.
            fingerprint: match &self.weights {
                Some(weights) => weights_fingerprint(weights)? + precision,
                None => path.canonicalize()?.display().to_string(),
            },
            dataset: &dataset,
            root: data,
            dataset_name: self.dataset.clone().unwrap_or_else(|| dataset_name(data, &index)),
            index: &index,
            target_size,
            device,
            out,
            group: &group,
        };
        let evaluation = evaluation.run(|done, of| {
            bar.set_length(of as u64);
            bar.set_position(done as u64);
            !signals::is_stop_requested()
        })?;
        bar.finish_and_clear();
        group.shutdown()?;
        if !group.is_main_process() {
            return Ok(Output::default());
        }
        let scenes = &evaluation.scenes;
        let missing = scenes.iter().find_map(|scene| Perceptual::explain_missing(&scene.scores.mean));
        missing.iter().for_each(|line| eprintln!("{line}"));
        warn_of_many(scenes.iter().flat_map(|scene| &scene.warnings));
        write_evaluation(out, &evaluation)?;
        let evaluations = [(out.clone(), evaluation)];
        write_report(&out.join(REPORT), &evaluations)?;
        let [(_, evaluation)] = evaluations;
        describe_evaluation(&out.join(REPORT), &evaluation)
    }
}

/// Describes the evaluation that `report` shows. Scenes that couldn't be scored make the command fail.
fn describe_evaluation(report: &Path, evaluation: &Evaluation) -> Result<Output> {
    let Evaluation { index, scenes, indexed_scenes, summary, failures, .. } = evaluation;
    let mut json = serde_json::to_value(evaluation)?;
    json["report"] = report.to_string_lossy().into();
    json["scenes"] = scenes.len().into();
    let Scores { psnr, ssim, lpips_vgg, lpips_alex, pixel_fraction } = summary.mean;
    let [vgg, alex] =
        [lpips_vgg, lpips_alex].map(|value| value.map_or("absent".into(), |value| format!("{value:.4}")));
    let masked = pixel_fraction
        .map_or(String::new(), |fraction| format!(", over {:.1} % of the pixels", 100. * fraction));
    let count = scenes.len();
    let text = format!(
        "{index}, {count} of {indexed_scenes} scenes: PSNR {psnr:.2}, SSIM {ssim:.4}, LPIPS-VGG {vgg}, LPIPS-Alex {alex}{masked}\n{}",
        report.display()
    );
    for failure in failures {
        eprintln!("{}: {}", failure.scene, failure.error);
    }
    let count = failures.len();
    let failed = || Error::failed(format!("{count} scenes could not be scored, the means are of the others"));
    Ok(Output { failure: (count > 0).then(failed), ..Output::new(json, text) })
}

/// Size of the protocol's images, [height, width] (spec 9.1).
const PROTOCOL_SIZE: [u32; 2] = [256, 256];

/// Returns the lines of a table of the scores of every view, and of their means.
fn table(scores: &CaptureScores) -> Vec<String> {
    let gaussians = scores.gaussians.map_or(String::new(), |n| format!(", {n} Gaussians"));
    let columns = [("LPIPS-VGG", scores.mean.lpips_vgg), ("LPIPS-Alex", scores.mean.lpips_alex)];
    let columns = columns.into_iter().filter(|(_, mean)| mean.is_some());
    let names: String = columns.map(|(name, _)| format!(" {name:>10}")).collect();
    let mut lines = vec![
        format!("{}: {} views{gaussians}", scores.scene, scores.views.len()),
        format!("{:<24} {:>8} {:>8}{names}", "view", "PSNR", "SSIM"),
    ];
    let views = scores.views.iter().map(|view| (view.image.as_str(), &view.scores));
    for (name, Scores { psnr, ssim, lpips_vgg, lpips_alex, .. }) in views.chain([("mean", &scores.mean)]) {
        let lpips = [lpips_vgg, lpips_alex].into_iter().flatten();
        let lpips: String = lpips.map(|distance| format!(" {distance:>10.4}")).collect();
        lines.push(format!("{name:<24} {psnr:>8.2} {ssim:>8.4}{lpips}"));
    }
    if let Some(fraction) = scores.mean.pixel_fraction {
        lines.push(format!("scored over {:.1} % of the pixels: the others are masked out", 100. * fraction));
    }
    lines
}
