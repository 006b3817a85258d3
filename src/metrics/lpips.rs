//! LPIPS in evaluation, with the networks whose weights are installed.

use super::Scores;
use super::psnr_ssim::mean_weight;
use crate::data::View;
use crate::error::Result;
use crate::io::{WEIGHTS_VARIABLE, find_pretrained, pretrained_folders};
use crate::loss::{Lpips, LpipsNetwork, fill_masked};
use crate::scene::ImageSize;
use tch::{Device, Tensor};

/// LPIPS networks whose weights were found.
#[derive(Debug)]
pub struct Perceptual {
    vgg: Option<Lpips>,
    alex: Option<Lpips>,
}

impl Perceptual {
    /// Loads the networks from the folders of pretrained weights. Missing weights aren't an error.
    ///
    /// # Errors
    /// Fails if a file holds something else.
    pub fn find(device: Device) -> Result<Self> {
        let load = |network: LpipsNetwork| {
            find_pretrained(network.file_name()).map(|path| Lpips::load(&path, network, device)).transpose()
        };
        Ok(Perceptual { vgg: load(LpipsNetwork::Vgg16)?, alex: load(LpipsNetwork::AlexNet)? })
    }

    /// Sets the LPIPS distances of `scores` between an image `[3, H, W]`, clamped to [0, 1], and the photo `ground_truth`, over the pixels
    /// that count (spec 7.9). A distance is `None` if its network is missing or the view is too small for it.
    pub(super) fn add_to(&self, scores: &mut Scores, image: &Tensor, ground_truth: &View) {
        scores.lpips_vgg = distance(self.vgg.as_ref(), image, ground_truth);
        scores.lpips_alex = distance(self.alex.as_ref(), image, ground_truth);
    }

    /// Returns `true` if `scores` lack a distance that the installed weights could compute for views of `size`.
    pub fn could_add_to(scores: &Scores, size: ImageSize) -> bool {
        let side = i64::from(size.height.min(size.width));
        let networks = [(LpipsNetwork::Vgg16, scores.lpips_vgg), (LpipsNetwork::AlexNet, scores.lpips_alex)];
        networks.into_iter().any(|(network, score)| {
            score.is_none()
                && side >= network.smallest_side()
                && find_pretrained(network.file_name()).is_some()
        })
    }

    /// Explains why `scores`, to which the available distances have been added, lack a distance. Returns `None` if they lack none.
    pub fn explain_missing(&self, scores: &Scores) -> Option<String> {
        let networks = [
            (LpipsNetwork::Vgg16, &self.vgg, scores.lpips_vgg),
            (LpipsNetwork::AlexNet, &self.alex, scores.lpips_alex),
        ];
        let absent: Vec<_> = networks.into_iter().filter(|(.., score)| score.is_none()).collect();
        let names = absent.iter().map(|(network, ..)| network.metric()).collect::<Vec<_>>().join(" and ");
        let (network, loaded, _) = absent.first()?;
        Some(match loaded {
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

fn distance(lpips: Option<&Lpips>, image: &Tensor, ground_truth: &View) -> Option<f64> {
    let lpips = lpips?;
    let size = image.size();
    let smallest = lpips.network().smallest_side();
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
