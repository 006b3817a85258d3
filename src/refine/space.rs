//! What is optimized: Gaussians themselves, or the tokens that a model decodes them from.

use super::config::RefineConfig;
use super::leaves::Leaves;
use super::relocate::relocate;
use crate::model::{Encoded, GlobalSplat, Stage};
use crate::optim::{Optimizer, ParameterGroup, Rule};
use crate::scene::{Gaussians, RawGaussians};
use rand_chacha::ChaCha8Rng;
use tch::Tensor;

/// Added to the root of the second moments: gradients of single Gaussians are small.
const EPSILON: f64 = 1e-15;

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
    optimizer: Optimizer,
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
        let optimizer = Optimizer::new(leaves.named().map(alone).into()).with_epsilon(EPSILON);
        GaussianSpace { leaves, optimizer, config: config.clone(), depth, degrees }
    }
}

/// A group of its own, whose learning rate is set before each step.
fn alone((name, t): (&str, &Tensor)) -> ParameterGroup {
    let parameters = vec![(name.into(), t.shallow_clone())];
    ParameterGroup { rule: Rule::AdamW, parameters, learning_rate: 0., weight_decay: 0. }
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
        let due = config.relocate_every > 0 && (step + 1).is_multiple_of(config.relocate_every);
        if due && progress < config.relocate_until {
            let changed = relocate(&self.leaves, config.dead, random);
            let changed = Tensor::from_slice(&changed).to_device(self.leaves.means.device());
            for moment in self.optimizer.moments() {
                let _ = moment.shallow_clone().index_fill_(1, &changed, 0.);
            }
        }
    }
}

/// What the encoder knows of a scene; the decoder stays as it is.
#[derive(Debug)]
pub struct TokenSpace<'a> {
    network: &'a GlobalSplat,
    stage: Stage,
    tokens: Encoded,
    optimizer: Optimizer,
    learning_rate: f64,
}

impl<'a> TokenSpace<'a> {
    /// Begins with `tokens`, from which `network` decodes the Gaussians of `stage`.
    pub fn new(network: &'a GlobalSplat, stage: Stage, tokens: &Encoded, config: &RefineConfig) -> Self {
        let tokens = tokens.map(|t| t.detach().copy().set_requires_grad(true));
        let groups = [("geometry", &tokens.geometry), ("appearance", &tokens.appearance)].map(alone);
        let optimizer = Optimizer::new(groups.into()).with_epsilon(EPSILON);
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
