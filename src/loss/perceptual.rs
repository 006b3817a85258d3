//! L_perc (SPEC section 7): pictures look as their truth, to a network that was trained on photos.

use super::{Lpips, LpipsNetwork, Vgg19};
use crate::config::LossConfig;
use crate::data::ImageSize;
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;
use tch::{Device, Kind, Tensor};

/// Which network compares.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PerceptualKind {
    /// None: L_perc is left out.
    None,
    /// Features of VGG-19.
    Vgg19,
    /// LPIPS with VGG-16.
    LpipsVgg,
    /// LPIPS with AlexNet.
    LpipsAlex,
}

/// A network that compares, with its weights.
#[derive(Debug)]
pub enum PerceptualLoss {
    /// Features of VGG-19.
    Vgg19(Vgg19),
    /// LPIPS.
    Lpips(Lpips),
}

impl PerceptualLoss {
    /// The network that `config` asks for, if any, from the file that it names, for pictures of `size`.
    ///
    /// # Errors
    /// A file that isn't there, and how to get it; one that holds another network; pictures too small for the network.
    pub fn load(config: &LossConfig, size: ImageSize, device: Device) -> Result<Option<Self>> {
        let file = config.perceptual_weights()?;
        let file = Path::new(&file);
        let (expected, how) = match config.perceptual {
            PerceptualKind::None => return Ok(None),
            PerceptualKind::Vgg19 => (
                "torchvision's vgg19 as a safetensors",
                "save_file(torchvision.models.vgg19(weights=\"IMAGENET1K_V1\").features.state_dict(prefix=\"features.\"), FILE) \
                 makes it, and loss.perceptual=\"lpips_vgg\" needs what make weights makes",
            ),
            PerceptualKind::LpipsVgg | PerceptualKind::LpipsAlex => {
                ("the weights of LPIPS", "make weights makes it")
            }
        };
        if !file.is_file() {
            let found = format!("{}, which is not there", file.display());
            return Err(Error::Request(format!(
                "loss.perceptual_weights is {found}, expected {expected} ({how})"
            )));
        }
        let lpips = |network| Lpips::load(file, network, device).map(PerceptualLoss::Lpips);
        let loss = match config.perceptual {
            PerceptualKind::LpipsVgg => lpips(LpipsNetwork::Vgg16)?,
            PerceptualKind::LpipsAlex => lpips(LpipsNetwork::AlexNet)?,
            _ => PerceptualLoss::Vgg19(Vgg19::load(file, device)?),
        };
        let smallest = loss.smallest_side();
        if i64::from(size.height.min(size.width)) < smallest {
            return Err(Error::Request(format!(
                "data.image_size is [{}, {}], expected {smallest} or more for loss.perceptual",
                size.height, size.width
            )));
        }
        Ok(Some(loss))
    }

    fn smallest_side(&self) -> i64 {
        match self {
            PerceptualLoss::Vgg19(_) => Vgg19::SMALLEST_SIDE,
            PerceptualLoss::Lpips(lpips) => lpips.network().smallest_side(),
        }
    }

    /// The mean over `rendered` [R·B, C, 3, H, W], R times `truth` [B, C, 3, H, W] along the batch: the truth's features are
    /// computed once and serve every part.
    pub fn loss(&self, rendered: &Tensor, truth: &Tensor) -> Tensor {
        let repeats = rendered.size()[0] / truth.size()[0];
        let parts = rendered.chunk(repeats, 0);
        let compared = match self {
            PerceptualLoss::Vgg19(network) => {
                let truth = tch::no_grad(|| network.features(truth));
                parts.iter().map(|part| network.compare(&network.features(part), &truth)).collect::<Vec<_>>()
            }
            PerceptualLoss::Lpips(lpips) => {
                let truth: Vec<Tensor> = tch::no_grad(|| lpips.features(truth).collect());
                let truth = || truth.iter().map(Tensor::shallow_clone);
                parts
                    .iter()
                    .map(|part| lpips.compare(lpips.features(part), truth()).mean(None::<Kind>))
                    .collect()
            }
        };
        Tensor::stack(&compared, 0).mean(None::<Kind>)
    }
}
