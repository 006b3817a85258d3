//! What an evaluation over a data set found: the contents of `scores.json`, which the report shows.

use super::scores::CaptureScores;
use crate::reconstruct::Input;
use serde::{Deserialize, Serialize};

/// One method (a model, somebody's splats, somebody's pictures) scored by one index.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Evaluation {
    /// How its row is called in tables.
    pub method: String,
    /// The data set's name, as `re10k` or `acid`.
    pub dataset: String,
    /// The index file's name.
    pub index: String,
    /// Context views of every scene.
    pub context_views: usize,
    /// What a model saw of them, where one was run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub input: Option<Input>,
    /// [height, width] of the pictures that were scored.
    pub image_size: [u32; 2],
    /// Scenes that the index names; the data set may hold fewer.
    pub indexed_scenes: usize,
    /// Means over the scenes.
    pub summary: Summary,
    /// What the scores cost, where a model was run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub efficiency: Option<Efficiency>,
    /// Processor, cores and device that computed it.
    pub machine: String,
    /// One by one, in the index's order.
    pub scenes: Vec<SceneScores>,
    /// Scenes that couldn't be scored, and why.
    pub failures: Vec<Failure>,
}

/// Means over scenes, each of which is a mean over its target views.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Summary {
    /// In dB.
    pub psnr: f64,
    /// As scikit-image's.
    pub ssim: f64,
    /// Absent where the network's weights were.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_vgg: Option<f64>,
    /// Absent where the network's weights were.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_alex: Option<f64>,
    /// Gaussians of a scene, where splats were scored.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gaussians: Option<f64>,
}

/// What reconstructing a scene costs.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Efficiency {
    /// Mean seconds of the forward pass, or passes, from views in memory to Gaussians, without scenes that warmed up, where there are
    /// others.
    pub forward_seconds: f64,
    /// Scenes that the mean is of.
    pub timed_scenes: usize,
    /// The largest resident size of the process, in bytes.
    pub peak_memory_bytes: u64,
    /// The largest amount of the GPU's memory in use, in bytes, where one was used and tells.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peak_device_memory_bytes: Option<u64>,
    /// Mean size of a scene's splat as a PLY.
    pub splat_bytes: f64,
}

/// One scene's scores.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SceneScores {
    /// Means over the target views, and each of them.
    #[serde(flatten)]
    pub scores: CaptureScores,
    /// Frames that were shown.
    pub context: Vec<usize>,
    /// Frames that had to be matched.
    pub target: Vec<usize>,
    /// Whether photos have fewer pixels than they were shown or matched with.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub enlarged: bool,
    /// Size of the splat as a PLY, where there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub splat_bytes: Option<u64>,
    /// What was left out of the splat's file, a sentence each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
    /// Of the forward pass, or passes, where a model was run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub forward_seconds: Option<f64>,
    /// Whether the scene was the process's first, whose time includes that of warming up.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub warm_up: bool,
    /// The largest resident size of the process up to then, in bytes, where a model was run and nothing else yet.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peak_memory_bytes: Option<u64>,
    /// The memory of the GPU that the process held then, in bytes, where one was used and tells.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_device_memory_bytes: Option<u64>,
}

/// A scene that couldn't be scored.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Failure {
    /// By which the index names it.
    pub scene: String,
    /// One sentence.
    pub error: String,
}

impl Summary {
    /// Of `scenes`, which are one at least. A distance that any scene lacks has no mean.
    pub fn of(scenes: &[SceneScores]) -> Self {
        let mean = |value: &dyn Fn(&CaptureScores) -> Option<f64>| {
            let values: Option<Vec<f64>> = scenes.iter().map(|scene| value(&scene.scores)).collect();
            values.map(|values| values.iter().sum::<f64>() / values.len() as f64)
        };
        Summary {
            psnr: mean(&|s| Some(s.psnr)).unwrap_or(f64::NAN),
            ssim: mean(&|s| Some(s.ssim)).unwrap_or(f64::NAN),
            lpips_vgg: mean(&|s| s.lpips_vgg),
            lpips_alex: mean(&|s| s.lpips_alex),
            gaussians: mean(&|s| s.gaussians.map(|n| n as f64)),
        }
    }
}

impl Efficiency {
    /// Of scenes that a model was run on; none where it wasn't.
    pub(super) fn of(scenes: &[SceneScores]) -> Option<Self> {
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

/// What a scene's files are called, before the ending: its name, or, where a file system, a shell or a web page could read that
/// as more than a name, one with `_` in such places and a checksum that tells it from others.
pub fn scene_file_name(scene: &str) -> String {
    /// File systems allow 255 bytes, of which an ending and a temporary file's name need some.
    const LONGEST: usize = 128;
    let harmless = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    if scene.len() <= LONGEST && scene.chars().all(harmless) {
        return scene.into();
    }
    let plain: String = scene.chars().take(LONGEST).map(|c| if harmless(c) { c } else { '_' }).collect();
    format!("{plain}-{:08x}", crc32fast::hash(scene.as_bytes()))
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
