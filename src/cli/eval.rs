use super::{
    Output, check_views, device, distributed, model, open_masked_capture, parse_holdout, progress,
    report_downscaling, signals, warn, warn_of_many,
};
use crate::data::{Capture, Dataset, Holdout, PhotoSize, Split};
use crate::error::Error;
use crate::eval::{
    DatasetEvaluation, EvalScene, Evaluation, EvaluationIndex, Method, REPORT, evaluation_files,
    weights_fingerprint, write_evaluation, write_report,
};
use crate::io::{InputFiles, check_writable_dir, check_writable_png};
use crate::metrics::{CaptureScores, ContactSheet, Perceptual, Scores};
use crate::model::Precision;
use crate::reconstruct::{LoadedModel, Model};
use crate::scene::ImageSize;
use anyhow::Result;
use clap::{ArgGroup, Args};
use serde_json::json;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use tch::Device;

/// Evaluate a model, splats or images against photos: PSNR, SSIM, and LPIPS if `make weights` was run.
///
/// One capture (--scene): with --weights the input views of the model are those that are not held out, and the others are its
/// targets; with --splat or --renders all views are targets.
///
/// A dataset (--data, --index, --out), by the paper's protocol: every scene's context frames are the input and its target
/// frames are scored. DIR gets report.html, scores.json, scores.csv and the scores of every scene as soon as they are computed;
/// the same command resumes an interrupted evaluation, and scores again what has changed since. Several indices make one
/// report. Splats from other methods are DIR/SCENE.ply, or .spz and the like, images from other methods DIR/SCENE/000012.png,
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
    /// Capture: a folder with a cameras.json, a transforms.json, a COLMAP model or Polycam's keyframes, or CHUNK.torch#KEY
    #[arg(long, value_name = "PATH", group = "photos")]
    scene: Option<PathBuf>,
    /// Folder of masks named like the photos, as in photo.jpg.png or photo.png: black pixels are not scored, nor seen by a model; by
    /// default the masks and transparency of the capture itself
    #[arg(long, value_name = "DIR", conflicts_with = "data")]
    masks: Option<PathBuf>,
    /// Dataset: a folder of chunks with an index.json, one with such a folder named test, or one of captures
    #[arg(long, value_name = "ROOT", group = "photos", requires_all = ["index", "out"])]
    data: Option<PathBuf>,
    /// Context and target frames of the dataset's scenes; may be given more than once
    #[arg(long, value_name = "FILE.json", requires = "data", conflicts_with = "scene")]
    index: Vec<PathBuf>,
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
    /// Score all pixels over this color, black or white, instead of leaving out what is masked or transparent, as NeRF's benchmarks do
    #[arg(long, value_name = "COLOR", value_parser = ["black", "white"], conflicts_with = "data")]
    mask_background: Option<String>,
    /// Target views: every:N, every:N+K, or none for the capture's own test split; by default as in the model's training, and for
    /// splats and images all
    #[arg(long, value_name = "WHICH", conflicts_with = "data")]
    holdout: Option<String>,
    /// Score only pixels that at least two of the photos that aren't held out show, by the depths on which these agree
    #[arg(long, conflicts_with = "data")]
    covered: bool,
    /// Also score depths by exact ones, as synth --depth writes them for the capture
    #[arg(long, value_name = "FILE.npy", conflicts_with_all = ["data", "renders"])]
    depth: Option<PathBuf>,
    /// Number of input photos, spread along the camera path; by default all that are not held out
    #[arg(long, value_name = "N", conflicts_with_all = ["splat", "renders", "data"])]
    views: Option<usize>,
    /// Height of the scored images in pixels, in the shape of the model's images, or square; by default the size of the model's
    /// images, for images from other methods 256 on a dataset, and on one capture the size of its photos
    #[arg(long, value_name = "PIXELS")]
    render_height: Option<u32>,
    /// Size of the scored images of a splat or of another method on one capture: their longer side, as in 1600, or WxH, to which
    /// photos are cropped and resized; by default the size of the photos
    #[arg(long, value_name = "N|WxH", conflicts_with_all = ["weights", "data", "render_height"])]
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

    /// Returns `true` if the processes that torchrun started share the work.
    pub fn is_shared(&self) -> bool {
        self.data.is_some()
    }

    fn run_scene(&self, scene: &Path, device: Device) -> Result<Output> {
        if let Some(sheet) = &self.sheet {
            check_writable_png(sheet)?;
        }
        let capture = open_masked_capture(scene, self.masks.as_deref())?;
        if let Some(sheet) = &self.sheet {
            let mut inputs = self.inputs(std::iter::once(self.method(None)));
            capture.add_input_files(&mut inputs);
            inputs.check_file(sheet)?;
        }
        let loaded = self.load_model(device)?;
        let model = loaded.as_ref().map(Model::from);
        let mut scene = self.one_scene(&capture, model)?;
        if let Some(color) = &self.mask_background {
            scene = scene.with_background(if color == "white" { 255 } else { 0 });
        }
        if self.covered {
            scene = scene.covered(self.holdout(model)?.unwrap_or(Holdout::None))?;
        }
        if let Some(depth) = &self.depth {
            scene = scene.with_depths(depth)?;
        }
        if self.render_height.is_some() && scene.enlarged {
            eprintln!("{}: {}", scene.name, model::ENLARGED);
        }
        let perceptual = Perceptual::new(device);
        let mut sheet = self.sheet.as_ref().map(|_| ContactSheet::new(scene.frames.target.len()));
        let scored =
            self.method(model).score(&scene, device, Some(&perceptual), |view, _, rendered, _| {
                let row = sheet.as_mut().zip(rendered);
                row.map_or(Ok(()), |(sheet, rendered)| sheet.add(&view.image.to_float(), rendered))
            })?;
        warn(&scored.warnings);
        if let Some((path, sheet)) = self.sheet.as_ref().zip(sheet) {
            report_downscaling(path, sheet.write(path)?);
        }
        if let Some(line) = Perceptual::explain_missing(&scored.scores.mean) {
            eprintln!("{line}");
        }
        let mut json = serde_json::to_value(&scored.scores)?;
        let mut lines = table(&scored.scores);
        json["peak_memory_bytes"] = perceptual.peak_memory().map(|peak| peak.host).into();
        if let Some(Model { config, .. }) = model {
            json["image_size"] = json!(self.target_size(model)?);
            json["input"] = json!({ "photos": scene.context.len(), "image_size": config.data.image_size });
            json["forward_seconds"] = json!(scored.forward_seconds);
            // Also score the trivial baselines that use only the input photos.
            for (key, name, scores) in [
                ("nearest_photo", "the nearest photo shown", scene.score_nearest_photo()?),
                ("mean_photo", "the mean photo shown", scene.score_mean_photo()?),
            ] {
                let Scores { psnr, cc_psnr, ssim, .. } = scores.mean;
                json["baselines"][key] = json!({ "psnr": psnr, "ssim": ssim });
                lines.push(format!("{name:<24} {psnr:>8.2} {cc_psnr:>8.2} {ssim:>8.4}"));
            }
        }
        Ok(Output::new(json, lines.join("\n")))
    }

    /// Returns the scene to evaluate: a model's input and target views; for splats and images, all photos as targets.
    fn one_scene(&self, capture: &Capture, model: Option<Model>) -> Result<EvalScene> {
        let target_size = self.target_size(model)?;
        let holdout = self.holdout(model)?;
        let (Some(Model { config, .. }), Some(held_out)) = (model, holdout) else {
            let size = match &self.size {
                Some(size) => size
                    .parse::<PhotoSize>()
                    .map_err(|expected| Error::request(format!("--size {size}: {expected}")))?,
                None => self.render_height.map_or(PhotoSize::Own, |_| PhotoSize::Exactly(target_size)),
            };
            return Ok(EvalScene::without_context(capture, holdout, size)?);
        };
        Ok(EvalScene::held_out(capture, held_out, self.views, config.data.image_size, target_size)?)
    }

    /// Returns the requested holdout, or else that of the model's training.
    fn holdout(&self, model: Option<Model>) -> Result<Option<Holdout>> {
        let requested = self.holdout.as_deref().map(parse_holdout).transpose()?;
        Ok(requested.or(model.map(|model| model.config.data.holdout)))
    }

    /// Returns the size of the scored images.
    fn target_size(&self, model: Option<Model>) -> Result<ImageSize> {
        let default = model.map_or(PROTOCOL_SIZE.into(), |model| model.config.data.image_size);
        let Some(height) = self.render_height else { return Ok(default) };
        let aspect = f64::from(default.width) / f64::from(default.height);
        let width = (f64::from(height) * aspect).round() as u32;
        if !(RENDER_SIDES.contains(&height) && RENDER_SIDES.contains(&width)) {
            let (least, most) = (RENDER_SIDES.start(), RENDER_SIDES.end());
            let why = format!(
                "--render-height is {height}, expected images with sides of {least} to {most} pixels"
            );
            return Err(Error::request(why).into());
        }
        Ok(ImageSize { height, width })
    }

    fn load_model(&self, device: Device) -> Result<Option<LoadedModel>> {
        let requested = model::parse_precision(&self.precision)?;
        let load = |path: &PathBuf| model::load(Some(path), requested, device);
        Ok(self.weights.as_ref().map(load).transpose()?)
    }

    /// Returns the input files of the evaluation; for a dataset, `methods` has one method per scene.
    fn inputs<'a>(&self, methods: impl Iterator<Item = Method<'a>>) -> InputFiles {
        let mut inputs = InputFiles::default();
        match &self.weights {
            Some(weights) => inputs.add(weights),
            None => methods.for_each(|method| method.add_input_files(&mut inputs)),
        }
        inputs
    }

    /// Returns an error if an output would replace an input.
    fn check_outputs<'a>(
        &self,
        dataset: &Dataset,
        out: &Path,
        evaluations: impl Iterator<Item = (&'a EvaluationIndex, &'a PathBuf)> + Clone,
    ) -> Result<()> {
        let method = self.method(None);
        let scenes = || evaluations.clone().flat_map(|(index, _)| index.scenes.keys());
        let mut inputs = self.inputs(scenes().map(|key| method.of_scene(key)));
        dataset.add_input_files(out, &mut inputs);
        evaluations.clone().for_each(|(index, _)| inputs.add(&index.file));
        inputs.check_folder(out)?;
        inputs.check_file(&out.join(REPORT))?;
        for (index, folder) in evaluations {
            let files = evaluation_files(folder, index.scenes.keys());
            files.iter().try_for_each(|file| inputs.check_file(file))?;
        }
        Ok(())
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
        let (Some(data), Some(out)) = (&self.data, &self.out) else { unreachable!("clap asks for both") };
        let indices =
            self.index.iter().map(|file| EvaluationIndex::read(file)).collect::<Result<Vec<_>, _>>()?;
        let folders = folders(out, &indices)?;
        if let Some(path) = self.splat.as_ref().or(self.renders.as_ref()).filter(|path| !path.is_dir()) {
            let expected = "a folder with those of every scene, for --data";
            return Err(Error::input(path, "what is to be scored", "no folder", expected).into());
        }
        let dataset = Dataset::open(data, Split::Test)?;
        warn_of_many(dataset.warnings.iter());
        check_writable_dir(out)?;
        self.check_outputs(&dataset, out, indices.iter().zip(&folders))?;
        let (loaded, path) = (self.load_model(device)?, self.path());
        let model = loaded.as_ref().map(Model::from);
        let target_size = self.target_size(model)?;
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        let precision = match model.map(|model| model.network.precision()) {
            Some(Precision::Bf16) => " bf16",
            _ => "",
        };
        // Splats and images are compared scene by scene, so it is the path of their folder that identifies them.
        let fingerprint = match &self.weights {
            Some(weights) => weights_fingerprint(weights)?,
            None => path.canonicalize()?.display().to_string(),
        };
        signals::handle_stop_requests();

        let mut evaluations = vec![];
        for (index, folder) in indices.iter().zip(folders) {
            let evaluation = DatasetEvaluation {
                method: self.method(model),
                name: self.name.clone().unwrap_or(format!("{stem}{precision}")),
                fingerprint: format!("{fingerprint}{precision}"),
                dataset: &dataset,
                root: data,
                dataset_name: DatasetEvaluation::dataset_name(self.dataset.as_deref(), data, index),
                index,
                target_size,
                device,
                out: &folder,
                group: &group,
            };
            let bar = progress::bar(0, "scenes");
            let evaluation = evaluation.run(|done, of| {
                bar.set_length(of as u64);
                bar.set_position(done as u64);
                !signals::is_stop_requested()
            })?;
            bar.finish_and_clear();
            if !group.is_main_process() {
                continue;
            }
            let mut means = evaluation.scenes.iter().map(|scene| &scene.scores.mean);
            if let Some(line) = means.find_map(Perceptual::explain_missing) {
                eprintln!("{line}");
            }
            let enlarged = evaluation.scenes.iter().filter(|scene| scene.enlarged).count();
            if self.render_height.is_some() && enlarged > 0 {
                eprintln!("{enlarged} of {} scenes: {}", evaluation.scenes.len(), model::ENLARGED);
            }
            warn_of_many(evaluation.scenes.iter().flat_map(|scene| &scene.warnings));
            write_evaluation(&folder, &evaluation)?;
            evaluations.push((folder, evaluation));
        }
        group.shutdown()?;
        if !group.is_main_process() {
            return Ok(Output::default());
        }
        let report = out.join(REPORT);
        write_report(&report, &evaluations)?;
        Ok(describe_evaluations(&report, &evaluations))
    }
}

/// Describes the evaluations in `report`. Scenes that couldn't be scored make the command fail.
fn describe_evaluations(report: &Path, evaluations: &[(PathBuf, Evaluation)]) -> Output {
    let summaries = evaluations.iter().map(|(folder, e)| {
        json!({
            "folder": folder.to_string_lossy(), "index": e.index, "dataset": e.dataset, "context_views": e.context_views,
            "image_size": e.image_size, "scenes": e.scenes.len(), "indexed_scenes": e.indexed_scenes, "summary": e.summary,
            "efficiency": e.efficiency, "failures": e.failures,
        })
    });
    let shown = |value: Option<f64>| value.map_or("absent".into(), |value| format!("{value:.4}"));
    let line = |(_, e): &(PathBuf, Evaluation)| {
        let Scores { psnr, ssim, lpips_vgg, lpips_alex, pixel_fraction, .. } = e.summary.mean;
        let masked = pixel_fraction.map(|fraction| format!(", over {:.1} % of the pixels", 100. * fraction));
        format!(
            "{}, {} of {} scenes: PSNR {psnr:.2}, SSIM {ssim:.4}, LPIPS-VGG {}, LPIPS-Alex {}{}\n",
            e.index,
            e.scenes.len(),
            e.indexed_scenes,
            shown(lpips_vgg),
            shown(lpips_alex),
            masked.unwrap_or_default()
        )
    };
    let text = evaluations.iter().map(line).collect::<String>() + &report.to_string_lossy();
    let summaries: Vec<_> = summaries.collect();
    let json = json!({ "report": report.to_string_lossy(), "evaluations": summaries });
    let failures: Vec<_> = evaluations.iter().flat_map(|(_, e)| &e.failures).collect();
    for failure in &failures {
        eprintln!("{}: {}", failure.scene, failure.error);
    }
    let count = failures.len();
    let failed = || Error::failed(format!("{count} scenes could not be scored, the means are of the others"));
    Output { failure: (count > 0).then(failed), ..Output::new(json, text) }
}

/// Size of the protocol's images, [height, width] (spec 9.1).
const PROTOCOL_SIZE: [u32; 2] = [256, 256];
/// Allowed sides of scored images in pixels: SSIM uses windows of 11×11.
const RENDER_SIDES: RangeInclusive<u32> = 11..=16_384;

/// Returns the output folder of each index's scores: `out` itself if there is only one index.
fn folders(out: &Path, indices: &[EvaluationIndex]) -> Result<Vec<PathBuf>> {
    let stem = |index: &EvaluationIndex| out.join(index.file.file_stem().unwrap_or_default());
    let folders: Vec<_> = match indices {
        [_] => vec![out.to_owned()],
        several => several.iter().map(stem).collect(),
    };
    match folders.iter().enumerate().find(|(i, folder)| folders[..*i].contains(folder)) {
        Some((_, twice)) => Err(Error::request(format!(
            "--index: two of them would go to {}, expected other names",
            twice.display()
        ))
        .into()),
        None => Ok(folders),
    }
}

/// Returns the lines of a table of the scores of every view, and of their means.
fn table(scores: &CaptureScores) -> Vec<String> {
    let gaussians = scores.gaussians.map_or(String::new(), |n| format!(", {n} Gaussians"));
    let mut lines = vec![format!("{}: {} views{gaussians}", scores.scene, scores.views.len())];
    type Value = fn(&Scores) -> Option<f64>;
    let others: [(_, Value); 3] = [
        ("LPIPS-VGG", |scores| scores.lpips_vgg),
        ("LPIPS-Alex", |scores| scores.lpips_alex),
        ("depth", |scores| scores.depth_error),
    ];
    // Columns without any value are left out.
    let has_values = |value: Value| scores.views.iter().any(|view| value(&view.scores).is_some());
    let others: Vec<_> = others.into_iter().filter(|(_, value)| has_values(*value)).collect();
    let names: String = others.iter().map(|(name, _)| format!(" {name:>10}")).collect();
    lines.push(format!("{:<24} {:>8} {:>8} {:>8}{names}", "view", "PSNR", "cc-PSNR", "SSIM"));
    let row = |name: &str, scores: &Scores| {
        let shown = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:.4}"));
        let others = others.iter().map(|(_, value)| format!(" {:>10}", shown(value(scores))));
        let Scores { psnr, cc_psnr, ssim, .. } = scores;
        format!("{name:<24} {psnr:>8.2} {cc_psnr:>8.2} {ssim:>8.4}{}", others.collect::<String>())
    };
    lines.extend(scores.views.iter().map(|view| row(&view.image, &view.scores)));
    lines.push(row("mean", &scores.mean));
    if let Some(fraction) = scores.mean.pixel_fraction {
        lines.push(format!(
            "scored over {:.1} % of the pixels: the others are masked out or not covered",
            100. * fraction
        ));
    }
    lines
}
