//! Optimizers over groups of named tensors, used for network weights and for Gaussians (tch's own optimizers can't save their state):
//! AdamW (Loshchilov & Hutter 2019), and Muon (Jordan et al. 2024) for matrices, with a state that can be saved (spec 8.5).

mod muon;

use crate::error::{Error, Result};
use crate::ffi::take_tensor;
use globalsplat_csrc::tensor_ops::{
    self as ffi, AdamArguments, AdamWOptions, adam, fused_adamw, norm, scale,
};
use muon::Matrices;
use std::collections::BTreeMap;
use std::path::Path;
use tch::{Device, Tensor};

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPS: f64 = 1e-8;
/// Constant added to the gradient norm before dividing by it, as in torch's `clip_grad_norm_`.
const CLIP_EPS: f64 = 1e-6;

/// Update rule of a parameter group.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpdateRule {
    /// AdamW: each element is updated by running means of its gradient and of the gradient's square.
    AdamW,
    /// Muon: each matrix is updated along the (semi-)orthogonal matrix nearest to the running mean of its gradients.
    Muon {
        /// Number of matrices stacked in each tensor of the group, `[parts · rows, columns]`. Each matrix is updated by itself.
        parts: i64,
    },
}

/// Group of tensors that share an update rule, a learning rate and a weight decay.
#[derive(Debug)]
pub struct ParameterGroup {
    /// Update rule.
    pub rule: UpdateRule,
    /// Leaf tensors that require gradients, with their names. No other group uses these names.
    pub parameters: Vec<(String, Tensor)>,
    /// Learning rate: the approximate size of a step.
    pub learning_rate: f64,
    /// Decoupled weight decay. A step shrinks every parameter by this share of it, times the learning rate.
    pub weight_decay: f64,
}

/// Tensor, its running moments and the index of its group.
#[derive(Debug)]
struct Parameter {
    name: String,
    value: Tensor,
    /// Running mean of the gradients.
    first: Tensor,
    /// Running mean of the squared gradients, which only AdamW keeps.
    second: Option<Tensor>,
    group: usize,
}

impl Parameter {
    /// Returns the running moments of the gradients, with their names.
    fn moments(&self) -> impl Iterator<Item = (&'static str, &Tensor)> {
        std::iter::once(("first", &self.first)).chain(self.second.iter().map(|second| ("second", second)))
    }
}

/// Returns the address by which the C++ side refers to a tensor. It is valid as long as the tensor lives.
fn address(t: &Tensor) -> usize {
    t.as_ptr() as usize
}

/// Returns the addresses of several tensors.
pub(super) fn addresses<'a>(tensors: impl IntoIterator<Item = &'a Tensor>) -> Vec<usize> {
    tensors.into_iter().map(address).collect()
}

/// Resets the gradients of `leaves` to undefined.
pub(crate) fn zero_grad<'a>(leaves: impl IntoIterator<Item = &'a Tensor>) {
    // SAFETY: the tensors outlive the call.
    unsafe { ffi::zero_grad(&addresses(leaves)) }.expect("leaves");
}

/// Optimizer over groups of named parameters. Gradients are iterated in the order of the parameters' names, whatever the groups.
#[derive(Debug)]
pub struct Optimizer {
    parameters: Vec<Parameter>,
    /// Groups without their parameters, which are in `parameters`.
    groups: Vec<ParameterGroup>,
    epsilon: f64,
    steps: i64,
}

impl Optimizer {
    /// Creates an optimizer for the parameters of `groups`, with moments of zero.
    ///
    /// # Panics
    /// Panics if two parameters have the same name.
    pub fn new(mut groups: Vec<ParameterGroup>) -> Self {
        let mut parameters = BTreeMap::new();
        for (index, group) in groups.iter_mut().enumerate() {
            for (name, value) in group.parameters.drain(..) {
                let zeros = || value.zeros_like().detach();
                let (first, second) = (zeros(), (group.rule == UpdateRule::AdamW).then(zeros));
                let parameter = Parameter { name: name.clone(), value, first, second, group: index };
                assert!(parameters.insert(name, parameter).is_none(), "each parameter once");
            }
        }
        let parameters = parameters.into_values().collect();
        Optimizer { parameters, groups, epsilon: EPS, steps: 0 }
    }

    /// Sets the ε that is added to the root of the second moments, instead of 1e-8.
    pub fn with_epsilon(self, epsilon: f64) -> Self {
        Optimizer { epsilon, ..self }
    }

    /// Replaces each parameter by the tensor of the same name in `parameters`, which has more elements along dimension `dim`. The moments of
    /// the new elements, which follow the others, are zero.
    ///
    /// # Panics
    /// Panics if a name is missing or if shapes don't fit.
    pub(crate) fn extend<'a>(
        &mut self,
        parameters: impl IntoIterator<Item = (&'a str, &'a Tensor)>,
        dim: i64,
    ) {
        let extended: BTreeMap<&str, &Tensor> = parameters.into_iter().collect();
        for parameter in &mut self.parameters {
            let value = extended[parameter.name.as_str()];
            for moment in std::iter::once(&mut parameter.first).chain(&mut parameter.second) {
                let zeros = value.zeros_like().detach();
                zeros.narrow(dim, 0, moment.size()[dim as usize]).copy_(moment);
                *moment = zeros;
            }
            parameter.value = value.shallow_clone();
        }
    }

    /// Sets the learning rates of the groups, in their order, from the next step on.
    pub fn set_learning_rates(&mut self, learning_rates: &[f64]) {
        for (group, &learning_rate) in self.groups.iter_mut().zip(learning_rates) {
            group.learning_rate = learning_rate;
        }
    }

    /// Returns the running means of the gradients and of their squares, which the caller may change in place.
    pub fn moments(&self) -> impl Iterator<Item = &Tensor> {
        self.parameters.iter().flat_map(Parameter::moments).map(|(_, moment)| moment)
    }

    /// Returns the running mean of the squared gradients of the parameter `name`.
    ///
    /// # Panics
    /// Panics if AdamW updates no parameter of that name.
    pub(crate) fn squared_gradients(&self, name: &str) -> &Tensor {
        let parameter = self.parameters.iter().find(|parameter| parameter.name == name);
        parameter.and_then(|parameter| parameter.second.as_ref()).expect("a parameter of AdamW")
    }

    /// Sets the learning rate of every group, from the next step on.
    pub fn set_learning_rate(&mut self, learning_rate: f64) {
        self.groups.iter_mut().for_each(|group| group.learning_rate = learning_rate);
    }

    /// Returns the gradients that the last backward pass left, with the parameters' names and in their order. [`Optimizer::gradient_norm`]
    /// and [`Optimizer::step`] see changes that are made to them in place.
    pub fn gradients(&self) -> impl Iterator<Item = (&str, Tensor)> {
        let gradients = self.parameters.iter().map(|p| (p.name.as_str(), p.value.grad()));
        gradients.filter(|(_, gradient)| gradient.defined())
    }

    /// Resets the gradients to undefined. The next backward pass stores its gradients instead of adding to earlier ones.
    pub fn zero_grad(&mut self) {
        zero_grad(self.parameters.iter().map(|p| &p.value));
    }

    /// Returns the norm of all gradients together, a scalar on their device.
    ///
    /// # Errors
    /// Returns an error if a GPU fails.
    pub fn gradient_norm(&self) -> Result<Tensor> {
        let gradients: Vec<Tensor> = self.gradients().map(|(_, gradient)| gradient).collect();
        // SAFETY: the tensors outlive the call, which returns the address of a new one.
        Ok(unsafe { take_tensor(norm(&addresses(&gradients)).map_err(Error::external)?) })
    }

    /// Scales the gradients, whose total norm is `norm`, so that the norm is at most `largest`.
    ///
    /// # Errors
    /// Returns an error if a GPU fails.
    pub fn clip_gradients(&self, norm: f64, largest: f64) -> Result<()> {
        if norm > largest {
            let gradients: Vec<Tensor> = self.gradients().map(|(_, gradient)| gradient).collect();
            // SAFETY: the tensors outlive the call, and nothing else works on them meanwhile.
            unsafe { scale(&addresses(&gradients), largest / (norm + CLIP_EPS)) }.map_err(Error::external)?;
        }
        Ok(())
    }

    /// Updates the parameters from their gradients, by the groups' rules and learning rates. On the CPU, AdamW takes one pass over memory;
    /// on a GPU, one launch updates many parameters.
    ///
    /// # Errors
    /// Returns an error if a GPU fails.
    pub fn step(&mut self) -> Result<()> {
        self.steps += 1;
        let is_here = self.parameters.iter().all(|p| p.value.device() == Device::Cpu);
        for group in 0..self.groups.len() {
            match self.groups[group].rule {
                UpdateRule::AdamW if is_here => self.update_on_the_cpu(group),
                UpdateRule::AdamW => self.update_fused(group)?,
                UpdateRule::Muon { parts } => self.update_matrices(group, parts),
            }
        }
        Ok(())
    }

    /// Returns the parameters of a group that have gradients, and these gradients.
    fn with_gradients(&self, group: usize) -> (Vec<&Parameter>, Vec<Tensor>) {
        let parameters = self.parameters.iter().filter(|p| p.group == group);
        let with_gradient =
            parameters.map(|p| (p, p.value.grad())).filter(|(_, gradient)| gradient.defined());
        with_gradient.map(|(p, gradient)| (p, gradient.contiguous())).unzip()
    }

    /// Updates a group by AdamW on the CPU, for the step that [`Optimizer::step`] has counted.
    fn update_on_the_cpu(&self, group: usize) {
        let bias_correction1 = 1. - BETA1.powi(self.steps as i32);
        let bias_correction2_sqrt = (1. - BETA2.powi(self.steps as i32)).sqrt();
        let ParameterGroup { learning_rate, weight_decay, .. } = self.groups[group];
        let (step_size, decay) = (learning_rate / bias_correction1, learning_rate * weight_decay);
        let (parameters, gradients) = self.with_gradients(group);
        for (p, gradient) in parameters.iter().zip(&gradients) {
            let arguments = AdamArguments {
                value: address(&p.value),
                gradient: address(gradient),
                first: address(&p.first),
                second: address(p.second.as_ref().expect("AdamW's")),
                step_size,
                bias_correction2_sqrt,
                decay,
                beta1: BETA1,
                beta2: BETA2,
                epsilon: self.epsilon,
            };
            // SAFETY: the tensors outlive the call, and nothing else works on them meanwhile.
            let done = unsafe { adam(&arguments) };
            done.expect("a parameter, its gradient and its moments are alike");
        }
    }

    /// Updates a group by libtorch's fused AdamW kernel.
    fn update_fused(&self, group: usize) -> Result<()> {
        let ParameterGroup { learning_rate, weight_decay, .. } = self.groups[group];
        let (parameters, gradients) = self.with_gradients(group);
        let values = addresses(parameters.iter().map(|p| &p.value));
        let first = addresses(parameters.iter().map(|p| &p.first));
        let second = addresses(parameters.iter().filter_map(|p| p.second.as_ref()));
        let numbers = AdamWOptions {
            steps: self.steps,
            learning_rate,
            weight_decay,
            beta1: BETA1,
            beta2: BETA2,
            epsilon: self.epsilon,
        };
        // SAFETY: the tensors outlive the call, and nothing else works on them meanwhile.
        unsafe { fused_adamw(&values, &addresses(&gradients), &first, &second, &numbers) }
            .map_err(Error::external)
    }

    /// Updates a group of matrices by Muon.
    fn update_matrices(&self, group: usize, parts: i64) {
        let ParameterGroup { learning_rate, weight_decay, .. } = self.groups[group];
        let (parameters, gradients) = self.with_gradients(group);
        let matrices = Matrices {
            values: parameters.iter().map(|p| &p.value).collect(),
            gradients: gradients.iter().collect(),
            means: parameters.iter().map(|p| &p.first).collect(),
        };
        muon::update(&matrices, parts, learning_rate, weight_decay);
    }

    /// Returns the number of updates done.
    pub fn steps(&self) -> i64 {
        self.steps
    }

    /// Sets the number of updates done.
    pub fn set_steps(&mut self, steps: i64) {
        self.steps = steps;
    }

    /// Returns the optimizer's state: the number of updates and all moments, without the parameters themselves.
    pub fn state(&self) -> BTreeMap<String, Tensor> {
        let mut state = BTreeMap::from([("steps".to_string(), Tensor::from_slice(&[self.steps]))]);
        for p in &self.parameters {
            for (name, moment) in p.moments() {
                state.insert(format!("{name}.{}", p.name), moment.shallow_clone());
            }
        }
        state
    }

    /// Loads a state that [`Optimizer::state`] returned for the same model and rules. `file` is the file that error messages name.
    ///
    /// # Errors
    /// Returns an error if a moment is missing or has another shape.
    pub fn load_state(&mut self, file: &Path, state: &BTreeMap<String, Tensor>) -> Result<()> {
        let find = |key: String, shape: Vec<i64>| {
            let moment = state.get(&key);
            moment.filter(|moment| moment.size() == shape).ok_or_else(|| {
                let found = moment.map_or("missing".into(), |moment| format!("shape {:?}", moment.size()));
                Error::input(file, key, found, format!("shape {shape:?}, by the model and train.optimizer"))
            })
        };
        self.steps = find("steps".into(), vec![1])?.int64_value(&[0]);
        for p in &self.parameters {
            for (name, moment) in p.moments() {
                moment.shallow_clone().copy_(find(format!("{name}.{}", p.name), p.value.size())?);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Kind;

    fn leaf(values: &[f32]) -> Tensor {
        Tensor::from_slice(values).set_requires_grad(true)
    }

    fn group(parameters: &[(&str, &Tensor)], learning_rate: f64, weight_decay: f64) -> ParameterGroup {
        let parameters = parameters.iter().map(|(name, t)| (name.to_string(), t.shallow_clone())).collect();
        ParameterGroup { rule: UpdateRule::AdamW, parameters, learning_rate, weight_decay }
    }

    /// Two implementations of a step: [`Optimizer::step`], which uses our own kernel for tensors on the CPU, and libtorch's fused kernel.
    const WAYS: [fn(&mut Optimizer) -> Result<()>; 2] = [Optimizer::step, |adamw| {
        adamw.steps += 1;
        (0..adamw.groups.len()).try_for_each(|group| adamw.update_fused(group))
    }];

    /// Elements of an extended parameter go on as they would alone, and the new ones begin without moments.
    #[test]
    fn extended_parameters_go_on() {
        let alone = leaf(&[1., 2.]);
        let (short, long) = (leaf(&[1., 2.]), leaf(&[0., 0., 5.]));
        let mut adamws = [&alone, &short].map(|t| Optimizer::new(vec![group(&[("a", t)], 1e-2, 0.)]));
        let step = |adamw: &mut Optimizer, leaf: &Tensor| {
            adamw.zero_grad();
            leaf.square().sum(Kind::Float).backward();
            adamw.step().unwrap();
        };
        step(&mut adamws[0], &alone);
        step(&mut adamws[1], &short);
        tch::no_grad(|| long.narrow(0, 0, 2).copy_(&short));
        adamws[1].extend([("a", &long)], 0);
        assert_eq!(adamws[1].squared_gradients("a").double_value(&[2]), 0.);
        step(&mut adamws[0], &alone);
        step(&mut adamws[1], &long);
        assert!(long.narrow(0, 0, 2).equal(&alone) && long.double_value(&[2]) < 5.);
    }

    /// Both implementations give the same values and moments after steps with clipped gradients. One parameter has no gradient at first.
    #[test]
    fn fused_and_single_tensor_steps_agree() {
        let sizes = [("a", 7), ("b", 1000), ("c", 1), ("d", 64)];
        let states = WAYS.map(|step| {
            let leaves = sizes.map(|(name, size)| {
                let values = Tensor::linspace(-1., 1., size, (Kind::Float, Device::Cpu));
                (name, (values * 3.).sin().set_requires_grad(true))
            });
            let named = leaves.each_ref().map(|(name, t)| (*name, t));
            let mut adamw = Optimizer::new(vec![group(&named[..2], 1e-2, 0.3), group(&named[2..], 3e-2, 0.)])
                .with_epsilon(1e-6);
            for i in 0..6 {
                adamw.zero_grad();
                let seen = if i < 2 { &named[..3] } else { &named[..] };
                let objective = seen.iter().map(|(_, t)| (*t * (t.detach() + i).cos()).sum(Kind::Float));
                objective.reduce(|a, b| a + b).expect("some").backward();
                adamw.clip_gradients(adamw.gradient_norm().unwrap().double_value(&[]), 2.).unwrap();
                step(&mut adamw).unwrap();
            }
            let mut state = adamw.state();
            state.extend(leaves.map(|(name, value)| (name.to_string(), value.detach())));
            state
        });
        let [ours, fused] = states;
        assert_eq!(ours.len(), 1 + 3 * sizes.len());
        for (name, ours) in &ours {
            let off = (ours - &fused[name]).abs().max().double_value(&[]);
            let largest = ours.abs().max().double_value(&[]);
            assert!(largest > 0. && off <= 1e-6 * largest, "{name} is off by {off:.1e} of {largest:.1e}");
        }
    }

    #[test]
    fn gradients_are_clipped_together() {
        let (a, b) = (leaf(&[0.]), leaf(&[0.]));
        let adamw = Optimizer::new(vec![group(&[("b", &b)], 1., 0.), group(&[("a", &a)], 1., 0.)]);
        (&a * 3. + &b * 4.).sum(Kind::Float).backward();
        let norm = adamw.gradient_norm().unwrap().double_value(&[]);
        assert!((norm - 5.).abs() < 1e-6);
        adamw.clip_gradients(norm, 10.).unwrap();
        assert_eq!(a.grad().double_value(&[0]), 3.);
        adamw.clip_gradients(norm, 1.).unwrap();
        assert!((a.grad().double_value(&[0]) - 0.6).abs() < 1e-5);
    }
}
