//! AdamW (Loshchilov & Hutter 2019), with a state that can be saved; tch's own can't.

use crate::error::{Error, Result};
use std::collections::BTreeMap;
use tch::{Tensor, nn};

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPS: f64 = 1e-8;

/// A variable and its running moments.
#[derive(Debug)]
struct Parameter {
    name: String,
    value: Tensor,
    first: Tensor,
    second: Tensor,
    decays: bool,
}

/// Decoupled weight decay on weights of two or more dimensions alone: not on biases, norms, LayerScale or learned tokens.
#[derive(Debug)]
pub struct AdamW {
    parameters: Vec<Parameter>,
    weight_decay: f64,
    steps: i64,
}

impl AdamW {
    /// For all trained variables of `vs`, moments at zero.
    pub fn new(vs: &nn::VarStore, weight_decay: f64) -> Self {
        let variables: BTreeMap<String, Tensor> = vs.variables().into_iter().collect();
        let parameters =
            variables.into_iter().filter(|(_, value)| value.requires_grad()).map(|(name, value)| Parameter {
                decays: name.ends_with(".weight") && value.dim() >= 2,
                first: value.zeros_like().detach(),
                second: value.zeros_like().detach(),
                name,
                value,
            });
        AdamW { parameters: parameters.collect(), weight_decay, steps: 0 }
    }

    /// Forgets the gradients.
    pub fn zero_grad(&mut self) {
        self.parameters.iter_mut().for_each(|p| p.value.zero_grad());
    }

    /// Scales the gradients so that their common norm is at most `largest`, and returns what it was.
    pub fn clip_gradients(&mut self, largest: f64) -> f64 {
        let gradients: Vec<Tensor> =
            self.parameters.iter().map(|p| p.value.grad()).filter(Tensor::defined).collect();
        let norms: Vec<Tensor> = gradients.iter().map(Tensor::norm).collect();
        let norm = Tensor::stack(&norms, 0).norm().double_value(&[]);
        if norm > largest {
            let factor = largest / (norm + 1e-6);
            gradients.into_iter().for_each(|mut g| {
                let _ = g.g_mul_scalar_(factor);
            });
        }
        norm
    }

    /// One update from the gradients that are there.
    pub fn step(&mut self, learning_rate: f64) {
        self.steps += 1;
        let correction1 = 1. - BETA1.powi(self.steps as i32);
        let correction2 = 1. - BETA2.powi(self.steps as i32);
        tch::no_grad(|| {
            for p in &mut self.parameters {
                let gradient = p.value.grad();
                if !gradient.defined() {
                    continue;
                }
                if p.decays {
                    let _ = p.value.g_mul_scalar_(1. - learning_rate * self.weight_decay);
                }
                let _ = p.first.lerp_(&gradient, 1. - BETA1);
                let _ = p.second.g_mul_scalar_(BETA2).addcmul_(&(&gradient * (1. - BETA2)), &gradient);
                let denominator = p.second.sqrt().divide_scalar(correction2.sqrt()) + EPS;
                let _ = p.value.addcdiv_(&(&p.first * (-learning_rate / correction1)), &denominator);
            }
        });
    }

    /// Everything but the variables themselves.
    pub fn state(&self) -> BTreeMap<String, Tensor> {
        let mut state = BTreeMap::from([("steps".to_string(), Tensor::from_slice(&[self.steps]))]);
        for p in &self.parameters {
            state.insert(format!("first.{}", p.name), p.first.shallow_clone());
            state.insert(format!("second.{}", p.name), p.second.shallow_clone());
        }
        state
    }

    /// Takes a state back that [`AdamW::state`] gave for the same model.
    ///
    /// # Errors
    /// A moment that is missing or has another shape.
    pub fn load_state(&mut self, state: &BTreeMap<String, Tensor>) -> Result<()> {
        let find = |key: String, shape: Vec<i64>| match state.get(&key) {
            Some(t) if t.size() == shape => Ok(t),
            _ => Err(Error::Request(format!("the optimizer's state has no {key} of shape {shape:?}"))),
        };
        self.steps = find("steps".into(), vec![1])?.int64_value(&[0]);
        for p in &mut self.parameters {
            p.first.copy_(find(format!("first.{}", p.name), p.value.size())?);
            p.second.copy_(find(format!("second.{}", p.name), p.value.size())?);
        }
        Ok(())
    }

    /// Names of the parameters that decay, for a look.
    pub fn decaying(&self) -> impl Iterator<Item = &str> {
        self.parameters.iter().filter(|p| p.decays).map(|p| p.name.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::{Device, Kind, nn::Init};

    #[test]
    fn steps_are_those_of_the_equations() {
        let vs = nn::VarStore::new(Device::Cpu);
        let weight = (vs.root() / "layer").var("weight", &[1, 1], Init::Const(2.));
        let bias = (vs.root() / "layer").var("bias", &[1], Init::Const(2.));
        let mut adamw = AdamW::new(&vs, 0.1);
        assert_eq!(adamw.decaying().collect::<Vec<_>>(), ["layer.weight"]);
        let (mut m, mut v, mut expected) = (0f64, 0f64, [2f64, 2f64]);
        for (i, gradient) in [0.5f64, -1.5, 0.25].into_iter().enumerate() {
            adamw.zero_grad();
            ((&weight + &bias).sum(Kind::Float) * gradient).backward();
            adamw.step(1e-2);
            let t = i as i32 + 1;
            (m, v) = (0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient * gradient);
            let update = 1e-2 * (m / (1. - 0.9f64.powi(t))) / ((v / (1. - 0.999f64.powi(t))).sqrt() + 1e-8);
            expected = [expected[0] * (1. - 1e-2 * 0.1) - update, expected[1] - update];
        }
        assert!((weight.double_value(&[0, 0]) - expected[0]).abs() < 1e-6);
        assert!((bias.double_value(&[0]) - expected[1]).abs() < 1e-6);
    }

    #[test]
    fn gradients_are_clipped_together() {
        let vs = nn::VarStore::new(Device::Cpu);
        let a = vs.root().var("a", &[1], Init::Const(0.));
        let b = vs.root().var("b", &[1], Init::Const(0.));
        let mut adamw = AdamW::new(&vs, 0.);
        (&a * 3. + &b * 4.).sum(Kind::Float).backward();
        assert!((adamw.clip_gradients(10.) - 5.).abs() < 1e-6);
        assert_eq!(a.grad().double_value(&[0]), 3.);
        adamw.clip_gradients(1.);
        assert!((a.grad().double_value(&[0]) - 0.6).abs() < 1e-5);
    }
}
