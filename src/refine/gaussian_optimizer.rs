//! Optimizer of Gaussians: a learning rate per kind of parameter, the degree of the spherical harmonics, relocation.

use super::config::RefineConfig;
use super::gaussian_params::GaussianParams;
use super::options::MIN_GAUSSIANS;
use super::relocate::relocate;
use super::state::{GAUSSIANS, Growth, Record, RefineState};
use crate::error::{Error, Result};
use crate::optim::{Optimizer, ParameterGroup, UpdateRule};
use crate::scene::{Gaussians, RawGaussians};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use tch::{Device, Tensor};

/// Exponent with which the learning rate of the means falls with the number of Gaussians above [`MIN_GAUSSIANS`].
const MEANS_POWER: f64 = 0.75;
/// Minimum weight of a step in the average of the parameters: the average reaches back about a hundred steps.
const MIN_AVERAGE_WEIGHT: f64 = 0.01;
/// Adam's ε, added to the root of the second moments. It is small because gradients of single Gaussians are small.
const EPSILON: f64 = 1e-15;

/// Gaussians that are optimized, with the state of Adam.
#[derive(Debug)]
pub struct GaussianOptimizer {
    params: GaussianParams,
    optimizer: Optimizer,
    config: RefineConfig,
    depth: f64,
    growth: Growth,
    /// Final number of Gaussians.
    last_count: i64,
    /// Average of the parameters over the last steps, once no Gaussian is moved any more.
    average: Option<GaussianParams>,
}

impl GaussianOptimizer {
    /// Creates an optimizer of the initial Gaussians `raw`, which grow to at least `count`. `depth` is the depth of the scene, the unit of
    /// lengths.
    pub fn new(raw: &RawGaussians, depth: f64, config: &RefineConfig, count: i64) -> Self {
        let first = raw.sh.size()[2].isqrt() - 1;
        let last_count = count.max(raw.means.size()[1]);
        let degrees = [first, first.max(config.sh_degree_for(last_count))];
        let params = GaussianParams::from_raw(raw, degrees[1]);
        let growth = Growth { first_count: params.count(), degrees, degree: first, averaged_steps: 0 };
        GaussianOptimizer::from_params(params, depth, config, growth, count)
    }

    /// Creates an optimizer of `params` without moments and averages.
    fn from_params(
        params: GaussianParams,
        depth: f64,
        config: &RefineConfig,
        growth: Growth,
        count: i64,
    ) -> Self {
        let optimizer = Optimizer::new(params.named_parameters().map(alone).into()).with_epsilon(EPSILON);
        let last_count = params.count().max(count);
        let config = config.clone();
        GaussianOptimizer { params, optimizer, config, depth, growth, last_count, average: None }
    }

    /// Creates the optimizer that `state` was made of, on `device`. The Gaussians grow to at least `count`.
    ///
    /// # Errors
    /// Returns an error if a tensor is missing or has another shape than the others.
    pub(super) fn from_state(
        state: &RefineState,
        config: &RefineConfig,
        count: i64,
        device: Device,
    ) -> Result<Self> {
        let Record { depth, growth, .. } = state.record;
        let read_params = |kind: &str| {
            GaussianParams::from_named(|name| state.tensor(&format!("{GAUSSIANS}{kind}.{name}")), device)
        };
        let params = read_params("value")?;
        let average = if growth.averaged_steps > 0 { Some(read_params("average")?.copy()) } else { None };
        let sizes = |params: &GaussianParams| params.named_parameters().map(|(_, t)| t.size());
        if let Some(found) = average.as_ref().map(sizes).filter(|found| *found != sizes(&params)) {
            let expected = format!("those of the parameters, {:?}", sizes(&params));
            return Err(Error::input(
                state.file(),
                "the sizes of the averages",
                format!("{found:?}"),
                expected,
            ));
        }
        let mut all = GaussianOptimizer::from_params(params, depth, config, growth, count);
        all.optimizer.load_state(state.file(), &state.tensors_of(GAUSSIANS))?;
        all.average = average;
        Ok(all)
    }

    /// Adds the parameters, their moments and their averages to `tensors`.
    pub(super) fn add_to_state(&self, tensors: &mut BTreeMap<String, Tensor>) {
        let named = |kind: &str, params: &GaussianParams| {
            params.named_parameters().map(|(name, t)| (format!("{kind}.{name}"), t.detach()))
        };
        let averages = self.average.iter().flat_map(|average| named("average", average));
        let all = named("value", &self.params).into_iter().chain(self.optimizer.state()).chain(averages);
        tensors.extend(all.map(|(name, t)| (format!("{GAUSSIANS}{name}"), t)));
    }

    /// Returns the number of Gaussians.
    pub(super) fn count(&self) -> i64 {
        self.params.count()
    }

    /// Returns how the Gaussians have grown.
    pub(super) fn growth(&self) -> Growth {
        self.growth
    }

    /// Returns the Gaussians, differentiable with respect to the parameters. `progress` goes from 0 to 1.
    pub fn gaussians(&self, progress: f64) -> Gaussians {
        self.activate(&self.params, progress)
    }

    /// Returns the average of the Gaussians over the last steps if there is one, else the current ones; not differentiable.
    pub(super) fn averaged_gaussians(&self) -> Gaussians {
        let params = self.average.as_ref().unwrap_or(&self.params);
        tch::no_grad(|| self.activate(params, 1.)).map(Tensor::copy)
    }

    fn activate(&self, params: &GaussianParams, progress: f64) -> Gaussians {
        Gaussians { antialiased: self.config.antialiased, ..params.activate(self.degree_at(progress)) }
    }

    /// Returns the degree of the spherical harmonics, at least the one that an earlier step used.
    fn degree_at(&self, progress: f64) -> i64 {
        let [first, last] = self.growth.degrees;
        (first + (progress / self.config.sh_every_for(last)) as i64).min(last).max(self.growth.degree)
    }

    /// Returns the number of Gaussians that there should be, which grows exponentially.
    fn count_at(&self, progress: f64) -> i64 {
        let [first, last] = [self.growth.first_count, self.last_count].map(|count| count as f64);
        (first * (last / first).powf((progress / self.config.grow_until).min(1.))) as i64
    }

    /// Returns the learning rate of the means, in units of the scene's depth. Many Gaussians are small, so they move less.
    pub(super) fn means_learning_rate(&self, progress: f64) -> f64 {
        let relative_count = self.last_count as f64 / MIN_GAUSSIANS as f64;
        let by_count = relative_count.max(1.).powf(-MEANS_POWER);
        self.config.lr_means * by_count * self.config.lr_means_final_factor.powf(progress)
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
        let others = config.lr_final_factor.powf(progress);
        // The order is that of `GaussianParams::named_parameters`.
        self.optimizer.set_learning_rates(&[
            self.means_learning_rate(progress) * self.depth,
            config.lr_scales * others,
            config.lr_quats * others,
            config.lr_opacities * others,
            config.lr_sh0 * others,
            config.lr_sh0 * config.lr_shN_factor * others,
        ]);
        self.optimizer.step()?;
        self.growth.degree = self.degree_at(progress);
        let missing = self.count_at(progress) - self.params.count();
        let is_due = config.relocate_every > 0 && (step + 1).is_multiple_of(config.relocate_every);
        // With few steps, no relocation may be due after the growth has ended.
        let is_late = missing > 0 && progress >= config.grow_until;
        if is_due && progress < config.relocate_until || is_late {
            if missing > 0 {
                self.params = self.params.append_dead(missing);
                self.optimizer.extend(self.params.named_parameters(), 1);
            }
            let squared_gradients = self.optimizer.squared_gradients("means");
            let changed = relocate(
                &self.params,
                squared_gradients,
                config.prune_opacity,
                config.relocation_noise,
                random,
            );
            let changed = Tensor::from_slice(&changed).to_device(self.params.means.device());
            for moment in self.optimizer.moments() {
                let _ = moment.shallow_clone().index_fill_(1, &changed, 0.);
            }
        }
        // A refinement that continues with more steps has an average that isn't over its last steps.
        if progress < config.relocate_until || is_late {
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
            for ((_, average), (_, t)) in
                average.named_parameters().iter().zip(self.params.named_parameters())
            {
                let _ = average.shallow_clone().lerp_(t, weight);
            }
        });
    }
}

/// Returns a parameter group with one parameter, whose learning rate is set before each step.
fn alone((name, t): (&str, &Tensor)) -> ParameterGroup {
    let parameters = vec![(name.into(), t.shallow_clone())];
    ParameterGroup { rule: UpdateRule::AdamW, parameters, learning_rate: 0., weight_decay: 0. }
}
