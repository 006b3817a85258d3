//! What the paper's tables say, method by method, exactly as printed there (spec 9.6).

use serde::Deserialize;
use std::collections::BTreeMap;
use std::sync::OnceLock;

/// Every table of results in the paper.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Published {
    /// RealEstate10K and ACID by number of context views, pictures of 256×256.
    pub novel_views: Vec<PublishedMethod>,
    /// Cost of a reconstruction from 24 context views, on an A100 with 64 GB.
    pub efficiency: Vec<PublishedEfficiency>,
    /// GlobalSplat on RealEstate10K by the number of latents and of Gaussians that each decodes to.
    pub compactness: Vec<PublishedCompactness>,
    /// GlobalSplat on RealEstate10K with one part changed.
    pub ablations: Vec<PublishedAblation>,
}

/// [height, width] of the pictures in [`Published::novel_views`].
pub const IMAGE_SIZE: [u32; 2] = [256, 256];

/// Data sets that are known by a name: in [`PublishedMethod::dataset`] and in files, and as people call them.
pub(super) const DATASETS: [(&str, &str); 3] =
    [("re10k", "RealEstate10K"), ("acid", "ACID"), ("dl3dv", "DL3DV")];

/// The name in files of the data set that is called `name`, either way.
pub(super) fn known_dataset(name: &str) -> Option<&'static str> {
    let is =
        |(file, people): &(&str, &str)| [file, people].iter().any(|known| known.eq_ignore_ascii_case(name));
    DATASETS.iter().find(|names| is(names)).map(|(file, _)| *file)
}

/// One method on one data set.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedMethod {
    /// `re10k` or `acid`.
    pub dataset: String,
    /// As the paper calls it.
    pub method: String,
    /// By the number of context views.
    pub scores: BTreeMap<usize, PublishedScores>,
}

/// What a table has for one method and number of context views; `None` where it has a dash.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct PublishedScores {
    /// In dB.
    pub psnr: Option<f64>,
    /// Structural similarity.
    pub ssim: Option<f64>,
    /// The table's LPIPS.
    pub lpips: Option<f64>,
    /// Thousands of Gaussians; `None` also for methods that make no Gaussians.
    pub kilo_gaussians: Option<f64>,
}

/// One method's cost.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedEfficiency {
    /// As the paper calls it.
    pub method: String,
    /// Largest allocation of the GPU's memory, in GB.
    pub peak_memory_gb: f64,
    /// One forward pass, in milliseconds.
    pub milliseconds: f64,
    /// A scene on disk, in MB; `None` for methods that write none.
    pub disk_mb: Option<f64>,
}

/// One size of the model.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedCompactness {
    /// In all.
    pub gaussians: u32,
    /// Scene tokens.
    pub latents: u32,
    /// Gaussians that a token decodes to.
    pub splats_per_token: u32,
    /// In dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
    /// The table's LPIPS.
    pub lpips: f64,
}

/// One variant of the model.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedAblation {
    /// What is different.
    pub variant: String,
    /// In dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
    /// The table's LPIPS.
    pub lpips: f64,
}

/// The paper's tables.
pub fn published() -> &'static Published {
    static TABLES: OnceLock<Published> = OnceLock::new();
    TABLES
        .get_or_init(|| serde_json::from_str(include_str!("published.json")).expect("the tests read it, too"))
}
