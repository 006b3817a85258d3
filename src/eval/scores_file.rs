//! Files of an evaluation: `scores.json` for programs and the report, `scores.csv` for spreadsheets, and the comparison images of its
//! scenes.

use super::evaluation::{Evaluation, scene_file_name};
use crate::error::{Error, Result};
use crate::io::{write_atomically, write_json};
use serde::Serialize;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// Range of PSNR in dB for images in [0, 1]: identical images have 100. The margin allows for rounding of means.
const POSSIBLE_PSNR: RangeInclusive<f64> = -0.001..=100.001;

pub(super) const SCORES: &str = "scores.json";
/// Name of the file of scores for spreadsheets.
pub const TABLE: &str = "scores.csv";
/// Name of the report's page.
pub const REPORT: &str = "report.html";

/// Returns the path of the comparison image of a scene's worst view in the evaluation's folder: ground truth, render, error and depth side
/// by side.
pub fn comparison_path(folder: &Path, scene: &str) -> PathBuf {
    folder.join("scenes").join(format!("{}.jpg", scene_file_name(scene)))
}

/// Writes `folder/scores.json`.
///
/// # Errors
/// Fails if the file can't be written.
pub fn write_evaluation(folder: &Path, evaluation: &Evaluation) -> Result<()> {
    Ok(write_json(&folder.join(SCORES), evaluation)?)
}

/// Reads `folder/scores.json`.
///
/// # Errors
/// Fails if the file is missing, isn't valid JSON, lacks a field, or has a PSNR outside 0 to 100 dB, which can't be plotted.
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
    check("the summary", evaluation.summary.mean.psnr)?;
    for scene in evaluation.scenes.iter().map(|scene| &scene.scores) {
        check(&format!("scene {}", scene.scene), scene.mean.psnr)?;
        for view in &scene.views {
            check(&format!("view {} of scene {}", view.image, scene.scene), view.scores.psnr)?;
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

/// Writes a line for every scene and target view to `path`. Missing values are left empty.
///
/// # Errors
/// Fails if the file can't be written.
pub fn write_csv(path: &Path, evaluation: &Evaluation) -> Result<()> {
    write_atomically(path, |writer| {
        let refused = |e: csv::Error| Error::write(path)(std::io::Error::other(e));
        let mut writer = csv::Writer::from_writer(writer);
        for scene in &evaluation.scenes {
            for view in &scene.scores.views {
                let line = Line {
                    scene: &scene.scores.scene,
                    view: &view.image,
                    psnr: view.scores.psnr,
                    ssim: view.scores.ssim,
                    lpips_vgg: view.scores.lpips_vgg,
                    lpips_alex: view.scores.lpips_alex,
                    gaussians: scene.scores.gaussians,
                    forward_seconds: scene.forward_seconds,
                };
                writer.serialize(line).map_err(refused)?;
            }
        }
        writer.flush().map_err(Error::write(path))
    })
}
