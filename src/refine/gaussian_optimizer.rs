//! Optimizer of Gaussians: a learning rate per kind of parameter, the degree of the spherical harmonics, relocation.

use super::gaussian_params::{GaussianParams, NAMES, leaf};
use super::options::{MIN_GAUSSIANS, RefineOptions};
use super::relocate::relocate;
use super::state::{Growth, Record, RefineState};
use crate::error::Result;
use crate::optim::{Optimizer, ParameterGroup, UpdateRule};
use crate::scene::{Gaussians, RawGaussians};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use tch::Tensor;

/// Exponent with which the learning rate of the means falls with the number of Gaussians above [`MIN_GAUSSIANS`].
const MEANS_POWER: f64 = 0.75;
/// Minimum weight of a step in the average of the parameters: the average reaches back about a hundred steps.
const MIN_AVERAGE_WEIGHT: f64 = 0.01;
/// Adam's ε, added to the root of the second moments. It is small because gradients of single Gaussians are small.
const EPSILON: f64 = 1e-15;

/// Gaussians that are optimized, with the state of Adam.
#[derive(Debug)]
pub(crate) struct GaussianOptimizer {
    params: GaussianParams,
    optimizer: Optimizer,
    options: RefineOptions,
    /// Depth of the scene, the unit of lengths.
    pub(super) depth: f64,
    pub(super) growth: Growth,
    /// Final number of Gaussians.
    last_count: i64,
    /// Average of the parameters over the last steps, once no Gaussian is moved any more.
    average: Option<GaussianParams>,
}

impl GaussianOptimizer {
    /// Creates an optimizer of the initial Gaussians `raw`, which grow to at least `count`. `depth` is the depth of the scene.
    pub(crate) fn new(raw: &RawGaussians, depth: f64, options: &RefineOptions, count: i64) -> Self {
        let first = raw.sh.size()[2].isqrt() - 1;
        let first_count = raw.means.size()[1];
        let degrees = [first, first.max(options.sh_degree_for(count.max(first_count)))];
        let params = GaussianParams::from_raw(raw, degrees[1]);
        let growth = Growth { first_count, degrees, degree: first, averaged_steps: 0 };
        GaussianOptimizer::from_params(params, depth, options, growth, count)
    }

    /// Creates an optimizer of `params` without moments and averages.
    fn from_params(
        params: GaussianParams,
        depth: f64,
        options: &RefineOptions,
        growth: Growth,
        count: i64,
    ) -> Self {
        // Each parameter is a group, whose learning rate is set before each step.
        let group = |(name, t): (&str, &Tensor)| ParameterGroup {
            rule: UpdateRule::AdamW,
            parameters: vec![(name.into(), t.shallow_clone())],
            learning_rate: 0.,
            weight_decay: 0.,
        };
        let optimizer = Optimizer::new(params.named().map(group).into()).with_epsilon(EPSILON);
        let last_count = params.count().max(count);
        let options = options.clone();
        GaussianOptimizer { params, optimizer, options, depth, growth, last_count, average: None }
    }

    /// Creates the optimizer that `state` was made of. The Gaussians grow to at least `count`.
    ///
    /// # Errors
    /// Returns an error if a moment is missing.
    pub(super) fn from_state(state: &RefineState, options: &RefineOptions, count: i64) -> Result<Self> {
        let Record { depth, growth, .. } = state.record;
        let read = |kind: &str| {
            let tensor = |name: &str| &state.gaussians[&format!("{kind}.{name}")];
            GaussianParams(NAMES.map(|name| leaf(&tensor(name).to_device(options.device))))
        };
        let average = (growth.averaged_steps > 0).then(|| read("average").copy());
        let mut all = GaussianOptimizer::from_params(read("value"), depth, options, growth, count);
        all.optimizer.load_state(&state.file, &state.gaussians)?;
        Ok(GaussianOptimizer { average, ..all })
    }

    /// Returns the parameters, their moments and their averages with their names in a state.
    pub(super) fn state(&self) -> BTreeMap<String, Tensor> {
        let kinds = [("value", Some(&self.params)), ("average", self.average.as_ref())];
        let mut state = self.optimizer.state();
        for (kind, params) in kinds {
            let named = params.into_iter().flat_map(GaussianParams::named);
            state.extend(named.map(|(name, t)| (format!("{kind}.{name}"), t.detach())));
        }
        state
    }

    /// Returns the number of Gaussians.
    pub(super) fn count(&self) -> i64 {
        self.params.count()
    }

    /// Returns the Gaussians, differentiable with respect to the parameters. `progress` goes from 0 to 1.
    pub(super) fn gaussians(&self, progress: f64) -> Gaussians {
        self.activate(&self.params, progress)
    }

    /// Returns the average of the Gaussians over the last steps if there is one, else the current ones; not differentiable.
    pub(super) fn averaged_gaussians(&self) -> Gaussians {
        let params = self.average.as_ref().unwrap_or(&self.params);
        tch::no_grad(|| self.activate(params, 1.)).map(Tensor::copy)
    }

    fn activate(&self, params: &GaussianParams, progress: f64) -> Gaussians {
        Gaussians { antialiased: self.options.antialiased, ..params.activate(self.degree_at(progress)) }
    }

    /// Returns the degree of the spherical harmonics, at least the one that an earlier step used.
    fn degree_at(&self, progress: f64) -> i64 {
        let [first, last] = self.growth.degrees;
        (first + (progress / self.options.sh_every_for(last)) as i64).min(last).max(self.growth.degree)
    }

    /// Returns the number of Gaussians that there should be, which grows exponentially.
    fn count_at(&self, progress: f64) -> i64 {
        let [first, last] = [self.growth.first_count, self.last_count].map(|count| count as f64);
        (first * (last / first).powf((progress / self.options.grow_until).min(1.))) as i64
    }

    /// Returns the learning rate of the means, in units of the scene's depth. Many Gaussians are small, so they move less.
    pub(super) fn means_learning_rate(&self, progress: f64) -> f64 {
        let relative_count = self.last_count as f64 / MIN_GAUSSIANS as f64;
        let by_count = relative_count.max(1.).powf(-MEANS_POWER);
        self.options.lr_means * by_count * self.options.lr_means_final_factor.powf(progress)
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
        let options = &self.options;
        let others = options.lr_final_factor.powf(progress);
        // In the order of `NAMES`.
        self.optimizer.set_learning_rates(&[
            self.means_learning_rate(progress) * self.depth,
            options.lr_scales * others,
            options.lr_quats * others,
            options.lr_opacities * others,
            options.lr_sh0 * others,
            options.lr_sh0 * options.lr_shN_factor * others,
        ]);
        self.optimizer.step()?;
        self.growth.degree = self.degree_at(progress);
        let missing = self.count_at(progress) - self.params.count();
        let is_due = options.relocate_every > 0 && (step + 1).is_multiple_of(options.relocate_every);
        // With few steps, no relocation may be due after the growth has ended.
        let is_late = missing > 0 && progress >= options.grow_until;
        if is_due && progress < options.relocate_until || is_late {
            if missing > 0 {
                self.params = self.params.append_dead(missing);
                self.optimizer.extend(self.params.named(), 1);
            }
            let squared_gradients = self.optimizer.squared_gradients("means");
            let changed = relocate(
                &self.params,
                squared_gradients,
                options.prune_opacity,
                options.relocation_noise,
                random,
            );
            let changed = Tensor::from_slice(&changed).to_device(self.params.0[0].device());
            for moment in self.optimizer.moments() {
                let _ = moment.shallow_clone().index_fill_(1, &changed, 0.);
            }
        }
        // A refinement that continues with more steps has an average that isn't over its last steps.
        if progress < options.relocate_until || is_late {
            (self.average, self.growth.averaged_steps) = (None, 0);
        } else {
            self.update_average();
        }
        Ok(())
    }

    /// Adds the parameters to their average.
    fn update_average(&mut self) {
        let average = self.average.get_or_insert_with(|| self.params.copy());
        self.growth.averaged_steps += 1;
        let weight = (1. / self.growth.averaged_steps as f64).max(MIN_AVERAGE_WEIGHT);
        tch::no_grad(|| {
            for (average, t) in average.0.iter_mut().zip(&self.params.0) {
                let _ = average.lerp_(t, weight);
            }
        });
    }
}
