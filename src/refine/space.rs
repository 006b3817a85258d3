//! What is optimized: Gaussians themselves, or the tokens that a model decodes them from.

use super::config::RefineConfig;
use super::leaves::Leaves;
use super::relocate::relocate;
use crate::model::{Encoded, GlobalSplat, Stage};
use crate::optim::{AdamW, ParameterGroup};
use crate::scene::{Gaussians, RawGaussians};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use tch::{Kind, Tensor};

/// Added to the root of the second moments: gradients of single Gaussians are small.
const EPSILON: f64 = 1e-15;

/// Opacity at which noise has half of its strength, and how sharply it ends.
const FAINT: f64 = 0.005;
const STEEPNESS: f64 = 100.;
/// Even numbers between this and its negative have variance 1.
const UNIT: f32 = 1.732_050_8;

/// Numbers that Gaussians follow from.
pub trait Space {
    /// The Gaussians, differentiable with respect to the numbers. `progress` goes from 0 to 1.
    fn gaussians(&self, progress: f64) -> Gaussians;

    /// Forgets the gradients.
    fn zero_grad(&mut self);

    /// Follows the gradients; `step` of them were followed before.
    fn step(&mut self, progress: f64, step: u64, random: &mut ChaCha8Rng);
}

/// Gaussians, each by itself.
#[derive(Debug)]
pub struct GaussianSpace {
    leaves: Leaves,
    optimizer: AdamW,
    config: RefineConfig,
    depth: f64,
    /// Degrees of spherical harmonics, at the beginning and in the end.
    degrees: [i64; 2],
}

impl GaussianSpace {
    /// Begins with `raw`; lengths are measured by `depth`, that of the scene.
    pub fn new(raw: &RawGaussians, depth: f64, config: &RefineConfig) -> Self {
        let first = raw.sh.size()[2].isqrt() - 1;
        let degrees = [first, first.max(config.sh_degree)];
        let leaves = Leaves::of(raw, degrees[1]);
        let optimizer = AdamW::new(leaves.named().map(alone).into()).with_epsilon(EPSILON);
        GaussianSpace { leaves, optimizer, config: config.clone(), depth, degrees }
    }
}

/// A group of its own, whose learning rate is set before each step.
fn alone((name, t): (&str, &Tensor)) -> ParameterGroup {
    ParameterGroup { parameters: vec![(name.into(), t.shallow_clone())], learning_rate: 0., weight_decay: 0. }
}

impl Space for GaussianSpace {
    fn gaussians(&self, progress: f64) -> Gaussians {
        let [first, last] = self.degrees;
        self.leaves.activate((first + (progress / self.config.sh_every) as i64).min(last))
    }

    fn zero_grad(&mut self) {
        self.optimizer.zero_grad();
    }

    fn step(&mut self, progress: f64, step: u64, random: &mut ChaCha8Rng) {
        let config = &self.config;
        let (means, others) = (config.means_end.powf(progress), config.others_end.powf(progress));
        // In the order of `Leaves::named`.
        self.optimizer.set_learning_rates(&[
            config.means * self.depth * means,
            config.log_scales * others,
            config.quaternions * others,
            config.opacity_logits * others,
            config.colours * others,
            config.colours * config.harmonics * others,
        ]);
        self.optimizer.step();
        if config.noise > 0. {
            shake(&self.leaves, config.noise * config.means * means, random);
        }
        let due = config.relocate_every > 0 && (step + 1).is_multiple_of(config.relocate_every);
        if due && progress < config.relocate_until {
            let changed = Tensor::from_slice(&relocate(&self.leaves, config.dead, random));
            for moment in self.optimizer.moments() {
                let _ = moment.shallow_clone().index_fill_(1, &changed, 0.);
            }
        }
    }
}

/// Moves Gaussians about within their own extent, by up to `length` of it in the middle, but only those that are all but invisible
/// (Kheradmand et al. 2024, eq. 9): they find out where they are needed.
fn shake(leaves: &Leaves, length: f64, random: &mut impl Rng) {
    tch::no_grad(|| {
        let faint = ((leaves.opacity_logits.sigmoid() * -1. + FAINT) * STEEPNESS).sigmoid() * length;
        let noise: Vec<f32> = (0..leaves.means.numel()).map(|_| random.random_range(-UNIT..UNIT)).collect();
        // Along the Gaussian's own axes, and then turned.
        let own =
            Tensor::from_slice(&noise).view_as(&leaves.means) * leaves.log_scales.exp() * faint.unsqueeze(-1);
        let _ = leaves.means.shallow_clone().g_add_(&turned(&own, &leaves.quaternions));
    });
}

/// Vectors [.., 3], each turned by its quaternion [.., 4] (w, x, y, z) of any length: v + 2 w (u × v) + 2 u × (u × v).
fn turned(vectors: &Tensor, quaternions: &Tensor) -> Tensor {
    let unit = quaternions / quaternions.square().sum_dim_intlist([-1].as_slice(), true, Kind::Float).sqrt();
    let (w, u) = (unit.narrow(-1, 0, 1), unit.narrow(-1, 1, 3));
    let across = u.linalg_cross(vectors, -1) * 2.;
    vectors + w * &across + u.linalg_cross(&across, -1)
}

/// What the encoder knows of a scene; the decoder stays as it is.
#[derive(Debug)]
pub struct TokenSpace<'a> {
    network: &'a GlobalSplat,
    stage: Stage,
    tokens: Encoded,
    optimizer: AdamW,
    learning_rate: f64,
}

impl<'a> TokenSpace<'a> {
    /// Begins with `tokens`, from which `network` decodes the Gaussians of `stage`.
    pub fn new(network: &'a GlobalSplat, stage: Stage, tokens: &Encoded, config: &RefineConfig) -> Self {
        let tokens = tokens.map(|t| t.detach().copy().set_requires_grad(true));
        let groups = [("geometry", &tokens.geometry), ("appearance", &tokens.appearance)].map(alone);
        let optimizer = AdamW::new(groups.into()).with_epsilon(EPSILON);
        TokenSpace { network, stage, tokens, optimizer, learning_rate: config.tokens }
    }
}

impl Space for TokenSpace<'_> {
    fn gaussians(&self, _: f64) -> Gaussians {
        self.network.decode(&self.tokens, self.stage).gaussians
    }

    fn zero_grad(&mut self) {
        self.optimizer.zero_grad();
    }

    fn step(&mut self, _: f64, _: u64, _: &mut ChaCha8Rng) {
        self.optimizer.set_learning_rate(self.learning_rate);
        self.optimizer.step();
    }
}
