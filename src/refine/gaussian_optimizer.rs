//! Optimizer of Gaussians: a learning rate per kind of parameter, the degree of the spherical harmonics, relocation.

use super::config::RefineConfig;
use super::gaussian_params::GaussianParams;
use super::relocate::relocate;
use crate::error::Result;
use crate::optim::{Optimizer, ParameterGroup, Rule};
use crate::scene::{Gaussians, RawGaussians};
use rand_chacha::ChaCha8Rng;
use tch::Tensor;

/// Adam's ε, added to the root of the second moments. It is small because gradients of single Gaussians are small.
const EPSILON: f64 = 1e-15;

/// Gaussians that are optimized, with the state of Adam.
#[derive(Debug)]
pub struct GaussianOptimizer {
    leaves: GaussianParams,
    optimizer: Optimizer,
    config: RefineConfig,
    depth: f64,
    /// Initial and final degree of the spherical harmonics.
    degrees: [i64; 2],
    /// Initial and final number of Gaussians.
    counts: [i64; 2],
}

impl GaussianOptimizer {
    /// Creates an optimizer of the initial Gaussians `raw`, which grow to at least `count`. `depth` is the depth of the scene, the unit of
    /// lengths.
    pub fn new(raw: &RawGaussians, depth: f64, config: &RefineConfig, count: i64) -> Self {
        let first = raw.sh.size()[2].isqrt() - 1;
        let degrees = [first, first.max(config.sh_degree)];
        let leaves = GaussianParams::from_raw(raw, degrees[1]);
        let optimizer = Optimizer::new(leaves.named_parameters().map(alone).into()).with_epsilon(EPSILON);
        let counts = [leaves.count(), leaves.count().max(count)];
        GaussianOptimizer { leaves, optimizer, config: config.clone(), depth, degrees, counts }
    }

    /// Returns the Gaussians, differentiable with respect to the parameters. `progress` goes from 0 to 1.
    pub fn gaussians(&self, progress: f64) -> Gaussians {
        let [first, last] = self.degrees;
        self.leaves.activate((first + (progress / self.config.sh_every) as i64).min(last))
    }

    /// Returns the number of Gaussians that there should be, which grows exponentially.
    fn count_at(&self, progress: f64) -> i64 {
        let [first, last] = self.counts.map(|count| count as f64);
        (first * (last / first).powf((progress / self.config.grow_until).min(1.))) as i64
    }

    /// Clears the gradients.
    pub(super) fn zero_grad(&mut self) {
        self.optimizer.zero_grad();
    }

    /// Updates the parameters by their gradients; `step` is the number of earlier updates.
    ///
    /// # Errors
    /// Returns an error if a GPU fails.
    pub(super) fn step(&mut self, progress: f64, step: u64, random: &mut ChaCha8Rng) -> Result<()> {
        let config = &self.config;
        let (means, others) = (config.means_end.powf(progress), config.lr_final_factor.powf(progress));
        // The order is that of `GaussianParams::named_parameters`.
        self.optimizer.set_learning_rates(&[
            config.means * self.depth * means,
            config.log_scales * others,
            config.quaternions * others,
            config.opacity_logits * others,
            config.colours * others,
            config.colours * config.harmonics * others,
        ]);
        self.optimizer.step()?;
        let missing = self.count_at(progress) - self.leaves.count();
        let is_due = config.relocate_every > 0 && (step + 1).is_multiple_of(config.relocate_every);
        // With few steps, no relocation may be due after the growth has ended.
        let is_late = missing > 0 && progress >= config.grow_until;
        if is_due && progress < config.relocate_until || is_late {
            if missing > 0 {
                self.leaves = self.leaves.with_dead(missing);
                self.optimizer.extend(self.leaves.named_parameters(), 1);
            }
            let squared_gradients = self.optimizer.squared_gradients("means");
            let changed =
                relocate(&self.leaves, squared_gradients, config.prune_opacity, config.spread, random);
            let changed = Tensor::from_slice(&changed).to_device(self.leaves.means.device());
            for moment in self.optimizer.moments() {
                let _ = moment.shallow_clone().index_fill_(1, &changed, 0.);
            }
        }
        Ok(())
    }
}

/// Returns a parameter group with one parameter, whose learning rate is set before each step.
fn alone((name, t): (&str, &Tensor)) -> ParameterGroup {
    let parameters = vec![(name.into(), t.shallow_clone())];
    ParameterGroup { rule: Rule::AdamW, parameters, learning_rate: 0., weight_decay: 0. }
}
