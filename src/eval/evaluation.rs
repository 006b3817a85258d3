//! Results of an evaluation over a dataset, and their files: `scores.json` for programs and the report, `scores.csv` for spreadsheets, and
//! the comparison images of the scenes.

use crate::error::{Error, Result};
use crate::io::{write_atomically, write_json};
use crate::metrics::{CaptureScores, Scores, ViewScore};
use crate::render::cpu::simd_level;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::process::Command;
use tch::Device;

/// Scores of one method (a model, given splats or given images) on the scenes of one index. [`DatasetEvaluation`](super::DatasetEvaluation)
/// computes them.
///
/// ```no_run
/// use globalsplat::eval::read_evaluation;
///
/// # fn main() -> globalsplat::Result<()> {
/// let evaluation = read_evaluation("results/re10k".as_ref())?;
/// println!("{} on {}: {:.2} dB", evaluation.method, evaluation.dataset, evaluation.summary.mean.psnr);
/// for scene in &evaluation.scenes {
///     println!("{}: {:.2} dB", scene.scores.scene, scene.scores.mean.psnr);
/// }
/// # Ok(())
/// # }
/// ```
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Evaluation {
    /// Name of the method's row in tables.
    pub method: String,
    /// Name of the dataset, such as `re10k` or `acid`.
    pub dataset: String,
    /// Name of the index file.
    pub index: String,
    /// Number of context views of every scene.
    pub context_views: usize,
    /// `[height, width]` of the images that were scored.
    pub image_size: [u32; 2],
    /// Number of scenes that the index names; the dataset may hold fewer.
    pub indexed_scenes: usize,
    /// Means over the scenes.
    pub summary: Summary,
    /// Time, memory and size; `None` if no model was run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub efficiency: Option<Efficiency>,
    /// Processor, cores and device that the scores were computed on.
    pub machine: String,
    /// Scores of each scene, in the order of the index.
    pub scenes: Vec<SceneScores>,
    /// Scenes that couldn't be scored, with the reason.
    pub failures: Vec<Failure>,
}

/// Means over scenes, each of which is a mean over its target views.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Summary {
    /// Mean scores.
    #[serde(flatten)]
    pub mean: Scores,
    /// Mean number of Gaussians per scene; `None` if no splats were scored.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gaussians: Option<f64>,
}

/// Cost of reconstructing a scene.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Efficiency {
    /// Mean time in seconds of the forward pass, or passes, from views in memory to Gaussians. Warm-up scenes are excluded unless there are
    /// no others.
    pub forward_seconds: f64,
    /// Number of scenes in the mean time.
    pub timed_scenes: usize,
    /// Peak resident memory of the process, in bytes.
    pub peak_memory_bytes: u64,
    /// Peak memory of the tensors on the GPU, in bytes; `None` without a GPU, or if it isn't known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peak_device_memory_bytes: Option<u64>,
    /// Mean size of a scene's splat as a PLY, in bytes.
    pub splat_bytes: f64,
}

/// Scores of one scene.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SceneScores {
    /// Means over the target views, and the scores of each view.
    #[serde(flatten)]
    pub scores: CaptureScores,
    /// Context frames.
    pub context: Vec<usize>,
    /// Target frames.
    pub target: Vec<usize>,
    /// `true` if photos had to be enlarged to the size of the context or target views.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub enlarged: bool,
    /// Size of the splat as a PLY, in bytes; `None` if there is no splat.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub splat_bytes: Option<u64>,
    /// Warnings about data that was left out of the splat's file, a sentence each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
    /// Time in seconds of the forward pass, or passes; `None` if no model was run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub forward_seconds: Option<f64>,
    /// `true` if the scene was the first one of the process, so that its time includes the warm-up.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub warm_up: bool,
    /// Peak resident memory of the process after the reconstruction, in bytes. Only the first scene that a process scores with a model has
    /// it: later peaks would include the networks of LPIPS.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peak_memory_bytes: Option<u64>,
    /// Peak memory of the tensors on the GPU after the reconstruction, in bytes. Only the first scene that a process scores with a model on
    /// a GPU has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_device_memory_bytes: Option<u64>,
}

/// A scene that couldn't be scored.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Failure {
    /// Key of the scene in the index.
    pub scene: String,
    /// Error message, one sentence.
    pub error: String,
}

impl Summary {
    /// Computes the means over `scenes`. A number of Gaussians that any scene lacks has no mean.
    pub fn from_scenes(scenes: &[SceneScores]) -> Self {
        let gaussians: Option<Vec<i64>> = scenes.iter().map(|scene| scene.scores.gaussians).collect();
        let mean = |counts: Vec<i64>| counts.iter().sum::<i64>() as f64 / counts.len() as f64;
        Summary {
            mean: Scores::mean(scenes.iter().map(|scene| &scene.scores.mean)),
            gaussians: gaussians.map(mean),
        }
    }
}

impl Efficiency {
    /// Computes the cost from the scenes that a model was run on; `None` if there are none.
    pub(super) fn from_scenes(scenes: &[SceneScores]) -> Option<Self> {
        let time = |scene: &SceneScores| scene.forward_seconds;
        let mut times: Vec<f64> = scenes.iter().filter(|scene| !scene.warm_up).filter_map(time).collect();
        if times.is_empty() {
            times = scenes.iter().filter_map(time).collect();
        }
        let bytes: Vec<f64> = scenes.iter().filter_map(|scene| Some(scene.splat_bytes? as f64)).collect();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        (!times.is_empty()).then(|| Efficiency {
            forward_seconds: mean(&times),
            timed_scenes: times.len(),
            peak_memory_bytes: scenes.iter().filter_map(|scene| scene.peak_memory_bytes).max().unwrap_or(0),
            peak_device_memory_bytes: scenes.iter().filter_map(|scene| scene.peak_device_memory_bytes).max(),
            splat_bytes: mean(&bytes),
        })
    }
}

/// Returns the name of a scene's files, without the extension. This is the scene's name, unless a file system, a shell or a web page could
/// read that as more than a name: then each such character is replaced by `_`, and a checksum keeps the names unique.
pub fn scene_file_name(scene: &str) -> String {
    /// Maximum number of characters of the name. File systems allow 255 bytes, some of which the extension and the name of a temporary file
    /// need.
    const LONGEST: usize = 128;
    let harmless = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    if scene.len() <= LONGEST && scene.chars().all(harmless) {
        return scene.into();
    }
    let plain: String = scene.chars().take(LONGEST).map(|c| if harmless(c) { c } else { '_' }).collect();
    format!("{plain}-{:08x}", crc32fast::hash(scene.as_bytes()))
}

/// Range of PSNR in dB for images in [0, 1]: identical images have 100. The margin allows for rounding of means.
const POSSIBLE_PSNR: RangeInclusive<f64> = -0.001..=100.001;

pub(super) const SCORES: &str = "scores.json";
pub(super) const TABLE: &str = "scores.csv";
/// Name of the report's page.
pub const REPORT: &str = "report.html";

/// Returns the path of the comparison image of a scene's worst view in the evaluation's folder: ground truth, render, error and depth side
/// by side.
pub fn comparison_path(folder: &Path, scene: &str) -> PathBuf {
    folder.join("scenes").join(format!("{}.jpg", scene_file_name(scene)))
}

/// Writes the evaluation to `folder`: `scores.json`, and `scores.csv`, which has a line for every scene and target view. Missing values are
/// empty in the latter.
///
/// # Errors
/// Fails if a file can't be written.
pub fn write_evaluation(folder: &Path, evaluation: &Evaluation) -> Result<()> {
    write_json(&folder.join(SCORES), evaluation)?;
    let path = folder.join(TABLE);
    write_atomically(&path, |writer| {
        let refused = |e: csv::Error| Error::write(&path)(std::io::Error::other(e));
        let mut writer = csv::Writer::from_writer(writer);
        for scene in &evaluation.scenes {
            for ViewScore { image, scores } in &scene.scores.views {
                let line = Line {
                    scene: &scene.scores.scene,
                    view: image,
                    psnr: scores.psnr,
                    ssim: scores.ssim,
                    lpips_vgg: scores.lpips_vgg,
                    lpips_alex: scores.lpips_alex,
                    gaussians: scene.scores.gaussians,
                    forward_seconds: scene.forward_seconds,
                };
                writer.serialize(line).map_err(refused)?;
            }
        }
        writer.flush().map_err(Error::write(&path))
    })
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

/// Returns the processor, its number of cores, the SIMD level, and the device unless it is the CPU, such as
/// `Intel(R) Xeon(R), 2 cores, avx512`.
///
/// # Errors
/// Fails if `GLOBALSPLAT_SIMD` names a SIMD level that this machine doesn't have.
pub(super) fn machine(device: Device) -> Result<String> {
    let processor = read_processor_name().unwrap_or(std::env::consts::ARCH.into());
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let gpu = match device {
        Device::Cpu => String::new(),
        other => format!(", {other:?}"),
    };
    Ok(format!("{processor}, {cores} cores, {}{gpu}", simd_level()?))
}

/// Returns the name of the processor, or `None` if the system doesn't tell it.
fn read_processor_name() -> Option<String> {
    if cfg!(target_os = "macos") {
        let output =
            Command::new("/usr/sbin/sysctl").args(["-n", "machdep.cpu.brand_string"]).output().ok()?;
        return Some(String::from_utf8(output.stdout).ok()?.trim().to_string())
            .filter(|name| !name.is_empty());
    }
    let cpu_info = std::fs::read_to_string("/proc/cpuinfo").ok()?;
    let (_, name) = cpu_info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'))?;
    Some(name.trim().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn odd_scene_names_make_plain_file_names() {
        assert_eq!(scene_file_name("a0-B_9.x"), "a0-B_9.x");
        assert_eq!(scene_file_name("../up/<b>é \n"), format!(".._up__b____-{:08x}", 0x91f3_02e8_u32));
        assert_ne!(scene_file_name("a/b"), scene_file_name("a_b"));
        assert_ne!(scene_file_name("a/b"), scene_file_name("a:b"));
        let long = |end: &str| scene_file_name(&("x".repeat(300) + end));
        assert!(long("1").len() < 200 && long("1") != long("2"));
    }
}
