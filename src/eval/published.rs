//! Published results: the paper's tables, method by method, exactly as printed (spec 9.6).

use serde::Deserialize;
use std::collections::BTreeMap;
use std::sync::OnceLock;

/// Every table of results in the paper.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Published {
    /// Results on RealEstate10K and ACID by number of context views, images of 256×256.
    pub novel_views: Vec<PublishedMethod>,
    /// Cost of a reconstruction from 24 context views, on an A100 with 64 GB.
    pub efficiency: Vec<PublishedEfficiency>,
    /// GlobalSplat on RealEstate10K by the number of latents and of Gaussians that each decodes to.
    pub compactness: Vec<PublishedCompactness>,
    /// GlobalSplat on RealEstate10K with one component changed.
    pub ablations: Vec<PublishedAblation>,
}

/// `[height, width]` of the images in [`Published::novel_views`].
pub const IMAGE_SIZE: [u32; 2] = [256, 256];

/// Known datasets: the key, as in [`PublishedMethod::dataset`] and in files, and the name for readers.
pub(super) const DATASETS: [(&str, &str); 3] =
    [("re10k", "RealEstate10K"), ("acid", "ACID"), ("dl3dv", "DL3DV")];

/// Returns the key of the dataset called `name`, which is the key or the name for readers, in any case.
pub(super) fn known_dataset(name: &str) -> Option<&'static str> {
    let is =
        |(file, people): &(&str, &str)| [file, people].iter().any(|known| known.eq_ignore_ascii_case(name));
    DATASETS.iter().find(|names| is(names)).map(|(file, _)| *file)
}

/// Scores of one method on one dataset, whose key is `re10k` or `acid`, by number of context views.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedMethod {
    pub dataset: String,
    pub method: String,
    pub scores: BTreeMap<usize, PublishedScores>,
}

/// Table entries for one method and number of context views; `None` where the table has a dash.
#[derive(Clone, Copy, Deserialize)]
pub struct PublishedScores {
    pub psnr: Option<f64>,
    pub ssim: Option<f64>,
    pub lpips: Option<f64>,
    /// Thousands of Gaussians; `None` also for methods that produce no Gaussians.
    pub kilo_gaussians: Option<f64>,
}

/// Cost of one method: its peak GPU memory allocation, the time of a forward pass, and the size of a scene on disk if it writes files.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedEfficiency {
    pub method: String,
    pub peak_memory_gb: f64,
    pub milliseconds: f64,
    pub disk_mb: Option<f64>,
}

/// Scores of one size of the model.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedCompactness {
    pub gaussians: u32,
    pub latents: u32,
    pub splats_per_token: u32,
    pub psnr: f64,
    pub ssim: f64,
    pub lpips: f64,
}

/// Scores of one variant of the model.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedAblation {
    pub variant: String,
    pub psnr: f64,
    pub ssim: f64,
    pub lpips: f64,
}

/// Returns the paper's tables.
pub fn published() -> &'static Published {
    static TABLES: OnceLock<Published> = OnceLock::new();
    let read = || serde_json::from_str(include_str!("published.json")).expect("the tests read it, too");
    TABLES.get_or_init(read)
}
