//! The files of an evaluation: `scores.json` for programs and the report, `scores.csv` for spreadsheets, and where the
//! pictures of its scenes lie.

use super::evaluation::{Evaluation, scene_file_name};
use crate::error::{Error, Result};
use crate::io::{write_atomically, write_json};
use serde::Serialize;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// Range of PSNR in dB for pictures in [0, 1]: identical pictures have 100. The margin is for rounding of means.
const POSSIBLE_PSNR: RangeInclusive<f64> = -0.001..=100.001;

pub(super) const SCORES: &str = "scores.json";
/// The scores for spreadsheets.
pub const TABLE: &str = "scores.csv";
/// The page that shows them.
pub const REPORT: &str = "report.html";

/// The picture of a scene's worst view in the folder of its evaluation: truth, render, error and depth side by side.
pub fn comparison_path(folder: &Path, scene: &str) -> PathBuf {
    folder.join("scenes").join(format!("{}.jpg", scene_file_name(scene)))
}

/// Writes `folder/scores.json`.
///
/// # Errors
/// The system's refusal to write.
pub fn write_evaluation(folder: &Path, evaluation: &Evaluation) -> Result<()> {
    write_json(&folder.join(SCORES), evaluation)
}

/// Reads `folder/scores.json`.
///
/// # Errors
/// A missing file, invalid JSON, a missing field, or a PSNR outside 0 to 100 dB, from which plots can't be drawn.
pub fn read_evaluation(folder: &Path) -> Result<Evaluation> {
    let path = folder.join(SCORES);
    let text = std::fs::read_to_string(&path).map_err(Error::read(&path))?;
    let evaluation: Evaluation = serde_json::from_str(&text).map_err(|e| {
        let found = format!("not the scores of an evaluation ({e})");
        Error::input(&path, "the file", found, "what globalsplat eval writes")
    })?;
    let check = |name: &str, psnr: f64| match POSSIBLE_PSNR.contains(&psnr) {
        true => Ok(()),
        false => Err(Error::input(&path, format!("psnr of {name}"), psnr, "0 to 100 dB")),
    };
    check("the summary", evaluation.summary.psnr)?;
    for scene in evaluation.scenes.iter().map(|scene| &scene.scores) {
        check(&format!("scene {}", scene.scene), scene.psnr)?;
        for view in &scene.views {
            check(&format!("view {} of scene {}", view.image, scene.scene), view.psnr)?;
        }
    }
    Ok(evaluation)
}

/// A line of `scores.csv`.
#[derive(Serialize)]
struct Line<'a> {
    scene: &'a str,
    view: &'a str,
    psnr: f64,
    ssim: f64,
    lpips_vgg: Option<f64>,
    lpips_alex: Option<f64>,
    gaussians: Option<i64>,
    forward_seconds: Option<f64>,
}

/// Writes a line for every scene and target view at `path`; what is absent stays empty.
///
/// # Errors
/// The system's refusal to write.
pub fn write_csv(path: &Path, evaluation: &Evaluation) -> Result<()> {
    write_atomically(path, |writer| {
        let refused = |e: csv::Error| Error::write(path)(std::io::Error::other(e));
        let mut writer = csv::Writer::from_writer(writer);
        for scene in &evaluation.scenes {
            for view in &scene.scores.views {
                let line = Line {
                    scene: &scene.scores.scene,
                    view: &view.image,
                    psnr: view.psnr,
                    ssim: view.ssim,
                    lpips_vgg: view.lpips_vgg,
                    lpips_alex: view.lpips_alex,
                    gaussians: scene.scores.gaussians,
                    forward_seconds: scene.forward_seconds,
                };
                writer.serialize(line).map_err(refused)?;
            }
        }
        writer.flush().map_err(Error::write(path))
    })
}
