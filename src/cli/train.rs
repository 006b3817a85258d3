use super::{Output, distributed, keep_freed_memory, progress, signals, warn_of_many};
use crate::config::Config;
use crate::data::{BadData, Capture, Dataset, SceneGroups, Split, TrainingScenes};
use crate::error::Error;
use crate::eval::{HeldOut, HeldOutScores};
use crate::io::{InputFiles, check_writable_dir};
use crate::loss::{Term, psnr_of_mse};
use crate::metrics::{CaptureScores, Scores};
use crate::train::{CONFIG_FILE, Event, METRICS_FILE, Outcome, Resume, Trainer, Validator, run};
use anyhow::Result;
use clap::Args;
use serde_json::json;
use std::ffi::OsString;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

/// Train a model on captures, or on chunks of RealEstate10K and the like.
///
/// Ctrl-C or SIGTERM saves a checkpoint and stops; the same command resumes from it. Periodically, and at the end, held-out
/// views and scenes are rendered and scored, compared with the baseline "nearest input photo"; RUN/best is the best checkpoint.
/// TensorBoard shows RUN/tensorboard.
///
/// Started by torchrun, several processes train together, each on a GPU of its own (--device cuda) or on threads of the CPU:
/// docs/distributed.md.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  globalsplat train --config configs/first_light.toml --out runs/first_light\n  \
    globalsplat train --config configs/tiny.toml --from models/tiny.safetensors --out runs/tuned --set 'data.captures=[\"mine\"]'\n  \
    torchrun --no-python --nproc-per-node=8 target/release/globalsplat train --config configs/re10k_16k.toml --out runs/re10k --device cuda"
)]
pub struct Train {
    /// Configuration file; see configs/
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Override a key of the configuration, as in train.steps=100
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Folder of the run: checkpoints, best, the resolved configuration, metrics.jsonl, tensorboard
    #[arg(long, value_name = "RUN")]
    out: PathBuf,
    /// Checkpoint to resume: auto: the newest in RUN if there is one; never: start from step 0; or a checkpoint's folder
    #[arg(long, value_name = "auto|never|PATH", default_value = "auto")]
    resume: OsString,
    /// Initial weights, if RUN has no checkpoint: of a model of the same shape, or of one with patches two, three or more times
    /// as wide, or with a half, a third or less of the scene tokens; all Gaussians are rendered from the first step on
    #[arg(long, value_name = "FILE")]
    from: Option<PathBuf>,
    /// Device: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
}

impl Train {
    pub fn run(self) -> Result<Output> {
        let (group, device) = distributed::join(&self.device)?;
        let (is_main_process, count) = (group.is_main_process(), group.world_size());
        let config = Config::read(&self.config, &self.set)?;
        // Recomputed rounds save memory, of which kept pages would take a third more.
        if !config.train.checkpoint_rounds {
            keep_freed_memory();
        }
        let resume = match self.resume.to_str() {
            Some("auto") => Resume::Auto,
            Some("never") => Resume::Never,
            _ => Resume::From(self.resume.clone().into()),
        };
        let scenes = Arc::new(TrainingScenes::find(&config.data.capture_paths()?)?);
        if scenes.sizes().is_empty() {
            return Err(Error::input(
                &self.config,
                "data.captures",
                "empty",
                "a capture, a folder of captures, or a dataset",
            )
            .into());
        }
        if is_main_process {
            check_writable_dir(&self.out)?;
            self.check_outputs(&config, &scenes)?;
        }
        let mut held_out = HeldOut::find(&config.data, &scenes)?;
        if let ([first, others @ ..], true) = (held_out.trained_on.as_slice(), is_main_process) {
            let more = if others.is_empty() { String::new() } else { format!(" and {} more", others.len()) };
            eprintln!(
                "{first}{more} of data.validation is also a training scene: its score says nothing about unseen scenes"
            );
        }
        let captures = scenes.captures.iter().flat_map(Capture::warnings);
        warn_of_many(scenes.warnings.iter().chain(captures).chain(&held_out.warnings));
        let mut trainer = Trainer::new(&config, scenes, device)?;
        if let Some(weights) = &self.from {
            trainer = trainer.with_weights(weights);
        }

        let mut trainer = trainer.with_group(group);
        if count > 1 && is_main_process {
            eprintln!("{count} processes train together: {} scenes in a step", trainer.batch());
        }

        let start = Instant::now();
        signals::handle_stop_requests();
        let outcome = self.train(&config, &mut trainer, &mut held_out, &resume)?;
        let seconds = start.elapsed().as_secs_f64();
        let bad_data = trainer.bad_data();
        trainer.group().shutdown()?;
        if !is_main_process {
            return Ok(Output::default());
        }
        if outcome.skipped > 0 {
            eprintln!("{} steps were skipped: their loss or gradient was not finite", outcome.skipped);
        }
        if bad_data.total() > 0 {
            eprintln!("{bad_data}");
        }
        if !outcome.complete {
            let checkpoint = outcome.checkpoint.display();
            let command = match resume {
                Resume::Auto => "the same command",
                Resume::Never | Resume::From(_) => "the same command with --resume auto",
            };
            anyhow::bail!("stopped; {checkpoint} is complete; {command} resumes");
        }
        self.report(&outcome, seconds, &held_out.scores, &bad_data)
    }

    /// Returns an error for a folder whose files would replace an input. The configuration may be the run's own, since it is
    /// rewritten unchanged.
    fn check_outputs(&self, config: &Config, scenes: &TrainingScenes) -> Result<()> {
        let mut inputs = InputFiles::default();
        scenes.add_input_files(&self.out, &mut inputs);
        for path in config.data.validation_paths()? {
            Dataset::open(&path, Split::Test)?.add_input_files(&self.out, &mut inputs);
        }
        self.from.iter().for_each(|path| inputs.add(path));
        inputs.check_folder(&self.out)?;
        let files = [CONFIG_FILE, METRICS_FILE].map(|name| self.out.join(name));
        Ok(files.iter().try_for_each(|file| inputs.check_file(file))?)
    }

    fn train(
        &self,
        config: &Config,
        trainer: &mut Trainer,
        held_out: &mut HeldOut,
        resume: &Resume,
    ) -> Result<Outcome> {
        let is_main_process = trainer.group().is_main_process();
        let bar = progress::bar(config.train.steps, "steps");
        let mut smooth_mse = None;
        let mut validation = String::new();
        let mut first = true;
        let validator = (!held_out.is_empty()).then_some(held_out as &mut dyn Validator);
        let outcome = run(trainer, &self.out, resume, validator, |event| {
            let should_continue = !signals::is_stop_requested();
            let (report, samples_per_second) = match event {
                Event::Step { report, samples_per_second } => (report, samples_per_second),
                Event::Validation(score) => {
                    validation = format!(" held out {:.2} dB (stage {})", score.psnr, score.stage.index);
                    return should_continue;
                }
                Event::Notice(text) => {
                    if is_main_process {
                        bar.suspend(|| eprintln!("{text}"));
                    }
                    return should_continue;
                }
                Event::Busy => return should_continue,
            };
            if first {
                bar.set_position(report.step);
                bar.reset_eta();
                first = false;
            }
            bar.set_position(report.step + 1);
            let mse = report.losses[Term::Mse];
            let mse = smooth_mse.map_or(mse, |old: f64| 0.98 * old + 0.02 * mse);
            // The loss of a skipped step may not be finite.
            smooth_mse = Some(mse).filter(|mse| mse.is_finite()).or(smooth_mse);
            bar.set_message(format!(
                "loss {:.4} PSNR {:.2} stage {} λ {:.2} lr {:.1e} {samples_per_second:.1} samples/s{validation}",
                report.losses.total,
                psnr_of_mse(mse),
                report.stage.index,
                report.stage.mix,
                report.learning_rate
            ));
            should_continue
        })?;
        bar.abandon();
        Ok(outcome)
    }

    fn report(
        &self,
        outcome: &Outcome,
        seconds: f64,
        validation: &[HeldOutScores],
        bad_data: &BadData,
    ) -> Result<Output> {
        let mean = |scores: fn(&HeldOutScores) -> &CaptureScores| {
            (!validation.is_empty()).then(|| Scores::mean(validation.iter().map(|v| &scores(v).mean)))
        };
        let (ours, nearest) = (mean(|v| &v.ours), mean(|v| &v.nearest));
        let checkpoint = outcome.checkpoint.to_string_lossy();
        let mut json = json!({
            "checkpoint": checkpoint,
            "seconds": seconds,
            "skipped_steps": outcome.skipped,
            "skipped_scenes": bad_data,
        });
        let mut lines = vec![format!("trained in {seconds:.0} s, checkpoint {checkpoint}")];
        if let Some((ours, nearest)) = ours.zip(nearest) {
            json["held_out"] = json!({
                "psnr": ours.psnr,
                "ssim": ours.ssim,
                "nearest_photo_psnr": nearest.psnr,
                "nearest_photo_ssim": nearest.ssim,
                "scenes": validation,
            });
            let row = |name: &str, ours: &Scores, nearest: &Scores| {
                format!("{name:<24} {:>10.2} {:>10.4} {:>14.2}", ours.psnr, ours.ssim, nearest.psnr)
            };
            lines.push(format!(
                "{:<24} {:>10} {:>10} {:>14}",
                "held-out views", "PSNR", "SSIM", "nearest photo"
            ));
            lines.extend(validation.iter().map(|v| row(&v.ours.scene, &v.ours.mean, &v.nearest.mean)));
            lines.push(format!("{}   {:+.2} dB", row("mean", &ours, &nearest), ours.psnr - nearest.psnr));
        }
        Ok(Output::new(json, lines.join("\n")))
    }
}
