//! LPIPS in evaluation, with the networks whose weights are installed.

use super::Scores;
use super::psnr_ssim::mean_weight;
use crate::data::View;
use crate::device::{peak_device_memory_bytes, peak_memory_bytes};
use crate::error::Result;
use crate::io::{WEIGHTS_VARIABLE, find_pretrained, pretrained_folders};
use crate::loss::{PerceptualBackbone, PerceptualNetwork, fill_masked};
use crate::scene::ImageSize;
use std::cell::OnceCell;
use tch::{Device, Tensor};

/// LPIPS networks whose weights are installed. They are loaded when they are first used, so that the memory of what is scored can be
/// measured without them.
#[derive(Debug)]
pub struct Perceptual {
    device: Device,
    networks: OnceCell<Vec<PerceptualNetwork>>,
    peak_memory: OnceCell<PeakMemory>,
}

/// Peak memory, in bytes.
#[derive(Debug, Clone, Copy)]
pub struct PeakMemory {
    /// Resident memory of the process.
    pub host: u64,
    /// Memory of the tensors on the GPU; `None` without a GPU, or if it isn't known.
    pub device: Option<u64>,
}

impl Perceptual {
    /// Creates the networks, which will be on `device`, without loading them.
    pub fn new(device: Device) -> Self {
        Perceptual { device, networks: OnceCell::new(), peak_memory: OnceCell::new() }
    }

    /// Loads the networks from the folders of pretrained weights, unless they are loaded. Missing weights aren't an error.
    ///
    /// # Errors
    /// Fails if a file holds something else.
    pub fn load(&self) -> Result<&[PerceptualNetwork]> {
        let peak = || PeakMemory { host: peak_memory_bytes(), device: peak_device_memory_bytes(self.device) };
        self.peak_memory.get_or_init(peak);
        if self.networks.get().is_none() {
            let found = PerceptualBackbone::LPIPS.into_iter();
            let found = found.filter_map(|network| Some((network, find_pretrained(&network.file_name())?)));
            let loaded = found.map(|(network, path)| PerceptualNetwork::load(&path, network, self.device));
            self.networks.set(loaded.collect::<Result<_>>()?).expect("only this thread sets it");
        }
        Ok(self.networks.get().expect("set above"))
    }

    /// Returns the peak memory before the networks were loaded; `None` if they aren't yet.
    pub fn peak_memory(&self) -> Option<PeakMemory> {
        self.peak_memory.get().copied()
    }

    /// Sets the LPIPS distances of `scores` between an image `[3, H, W]`, clamped to [0, 1], and the photo `ground_truth`, over the pixels
    /// that count (spec 7.9). A distance is `None` if its network is missing or the view is too small for it.
    pub(super) fn add_to(&self, scores: &mut Scores, image: &Tensor, ground_truth: &View) -> Result<()> {
        for lpips in self.load()? {
            let score = match lpips.backbone() {
                PerceptualBackbone::LpipsAlex => &mut scores.lpips_alex,
                _ => &mut scores.lpips_vgg,
            };
            *score = distance(lpips, image, ground_truth);
        }
        Ok(())
    }

    /// Returns `true` if `scores` lack a distance that the installed weights could compute for views of `size`.
    pub fn could_add_to(scores: &Scores, size: ImageSize) -> bool {
        let side = i64::from(size.height.min(size.width));
        absent(scores)
            .any(|network| side >= network.smallest_side() && find_pretrained(&network.file_name()).is_some())
    }

    /// Explains why `scores`, to which the available distances have been added, lack a distance. Returns `None` if they lack none.
    pub fn explain_missing(scores: &Scores) -> Option<String> {
        let network = absent(scores).next()?;
        let names = absent(scores).map(PerceptualBackbone::metric).collect::<Vec<_>>().join(" and ");
        Some(match find_pretrained(&network.file_name()) {
            Some(_) => {
                format!("left out: {names}, which needs views of {0}×{0} or more", network.smallest_side())
            }
            None => {
                let path = pretrained_folders()[0].join(network.file_name());
                let path = path.display();
                format!(
                    "left out: {names}; {path} is missing (make weights makes it, {WEIGHTS_VARIABLE} names its folder)"
                )
            }
        })
    }
}

/// Returns the networks whose distances `scores` lack.
fn absent(scores: &Scores) -> impl Iterator<Item = PerceptualBackbone> {
    let networks = [
        (PerceptualBackbone::LpipsVgg, scores.lpips_vgg),
        (PerceptualBackbone::LpipsAlex, scores.lpips_alex),
    ];
    networks.into_iter().filter(|(_, score)| score.is_none()).map(|(network, _)| network)
}

fn distance(lpips: &PerceptualNetwork, image: &Tensor, ground_truth: &View) -> Option<f64> {
    let size = image.size();
    let smallest = lpips.backbone().smallest_side();
    if size[1] < smallest || size[2] < smallest {
        return None;
    }
    let prepare = |image: &Tensor| image.to_device(lpips.device()).clamp(0., 1.);
    let (image, photo) = (prepare(image), prepare(&ground_truth.image.to_float()));
    let distance = |image: &Tensor| tch::no_grad(|| lpips.distance(image, &photo)).double_value(&[]);
    Some(match &ground_truth.mask {
        Some(mask) => {
            let mask = mask.to_float();
            distance(&fill_masked(&image, &photo, &prepare(&mask))) / mean_weight(&mask)
        }
        None => distance(&image),
    })
}
