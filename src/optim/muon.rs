//! Muon (Jordan et al. 2024). A matrix is updated along the nearest matrix to the running mean of its gradients whose singular values are
//! all about equal. So directions with small gradients are learned as fast as others (spec 8.5).

use super::addresses;
use globalsplat_csrc::tensor_ops::{self as ffi, MuonOptions};
use std::collections::BTreeMap;
use tch::{Device, Kind, Tensor, no_grad};

const BETA: f64 = 0.95;
/// Root mean square of an update's elements, in units of the learning rate. It makes updates as large as AdamW's (Liu et al. 2025).
const SIZE: f64 = 0.2;
/// Number of Newton-Schulz iterations.
const ROUNDS: usize = 5;
const COEFFICIENTS: [f64; 3] = [3.4445, -4.7750, 2.0315];
const NORM_EPS: f64 = 1e-7;

/// Tensors `[parts · rows, columns]` to update, their gradients, and the running means of the gradients.
#[derive(Debug)]
pub(super) struct Matrices<'a> {
    pub values: Vec<&'a Tensor>,
    pub gradients: Vec<&'a Tensor>,
    pub means: Vec<&'a Tensor>,
}

/// Updates all matrices: with our own kernel for float32 on the CPU, with libtorch otherwise.
pub(super) fn update(of: &Matrices, parts: i64, learning_rate: f64, weight_decay: f64) {
    let is_here = |t: &&Tensor| t.device() == Device::Cpu && t.kind() == Kind::Float;
    if !of.values.iter().all(is_here) {
        return update_by_libtorch(of, parts, learning_rate, weight_decay);
    }
    let list = |tensors: &[&Tensor]| addresses(tensors.iter().copied());
    let numbers = MuonOptions { parts, learning_rate, weight_decay, beta: BETA };
    // SAFETY: the tensors outlive the call, and nothing else works on them meanwhile.
    let done = unsafe { ffi::muon(&list(&of.values), &list(&of.gradients), &list(&of.means), &numbers) };
    done.expect("matrices, their gradients and running means are alike");
}

/// Updates all matrices with libtorch, on any device and in any kind. Matrices of one shape are processed together.
fn update_by_libtorch(of: &Matrices, parts: i64, learning_rate: f64, weight_decay: f64) {
    let mut alike: BTreeMap<Vec<i64>, Vec<usize>> = BTreeMap::new();
    for (i, value) in of.values.iter().enumerate() {
        alike.entry(value.size()).or_default().push(i);
    }
    no_grad(|| {
        for (size, which) in alike {
            let ahead: Vec<Tensor> = which
                .iter()
                .map(|&i| {
                    let mean = of.means[i].shallow_clone().lerp_(of.gradients[i], 1. - BETA);
                    of.gradients[i].lerp(&mean, BETA)
                })
                .collect();
            let (rows, columns) = (size[0] / parts, size[1]);
            let steps = orthogonalize(&Tensor::cat(&ahead, 0).view([-1, rows, columns]))
                .reshape([-1, size[0], columns]);
            let rate = learning_rate * SIZE * (rows.max(columns) as f64).sqrt();
            for (k, &i) in which.iter().enumerate() {
                let mut value = of.values[i].shallow_clone();
                let _ = value.g_mul_scalar_(1. - learning_rate * weight_decay);
                let _ = value.g_sub_(&(steps.get(k as i64) * rate));
            }
        }
    });
}

/// Returns the matrices nearest to `matrices`, `[n, rows, columns]`, whose singular values are all about 1. They are between 0.68 and 1.21,
/// except those that were below 0.0015 of the matrix's norm.
fn orthogonalize(matrices: &Tensor) -> Tensor {
    let is_upright = matrices.size()[1] > matrices.size()[2];
    let flat = if is_upright { matrices.transpose(1, 2) } else { matrices.shallow_clone() };
    let norms = flat.square().sum_dim_intlist([1i64, 2].as_slice(), true, None::<Kind>).sqrt();
    let mut x = flat / (norms + NORM_EPS);
    let [a, b, c] = COEFFICIENTS;
    for _ in 0..ROUNDS {
        let square = x.bmm(&x.transpose(1, 2));
        let factors = square.baddbmm(&square, &square, b, c);
        x = x.baddbmm(&factors, &x, a, 1.);
    }
    if is_upright { x.transpose(1, 2) } else { x }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the values and running means after three steps, for matrices of all shapes. The initial values are as small as a step.
    fn stepped(kind: Kind, update: fn(&Matrices, i64, f64, f64), parts: i64) -> Vec<Tensor> {
        let sizes = [(128, 128), (20, 33), (33, 20), (1, 7), (7, 1), (64, 130), (260, 65), (128, 512)];
        let numbers = |size: [i64; 2], phase: f64| {
            let count = (size[0] * size[1]) as f64;
            let numbers =
                Tensor::linspace(phase, phase + count, size[0] * size[1], (Kind::Double, Device::Cpu));
            (numbers.square() * 0.7).sin().view(size).to_kind(kind)
        };
        let sizes = sizes.map(|(rows, columns)| [parts * rows, columns]);
        let values: Vec<Tensor> = sizes.iter().map(|&size| numbers(size, 1.) * 1e-3).collect();
        let means: Vec<Tensor> = values.iter().map(Tensor::zeros_like).collect();
        for step in 0..3 {
            let gradients: Vec<Tensor> =
                sizes.iter().map(|&size| numbers(size, 2. + step as f64) * 1e-4).collect();
            let [values, means, gradients] = [&values, &means, &gradients].map(|all| all.iter().collect());
            update(&Matrices { values, gradients, means }, parts, 0.01, 0.3);
        }
        values.into_iter().chain(means).map(|t| t.to_kind(Kind::Double)).collect()
    }

    #[test]
    fn our_kernel_and_libtorch_agree() {
        for parts in [1, 3] {
            let exact = stepped(Kind::Double, update, parts);
            for way in [update, update_by_libtorch] {
                for (found, exact) in stepped(Kind::Float, way, parts).iter().zip(&exact) {
                    let error = ((found - exact).norm() / exact.norm()).double_value(&[]);
                    assert!(error < 1e-5, "{:?}, {parts} parts: {error:.1e}", exact.size());
                }
            }
        }
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        use globalsplat_csrc::runtime::set_num_threads;
        let expected = stepped(Kind::Float, update, 3);
        for threads in [1, 2, 3] {
            set_num_threads(threads);
            let found = stepped(Kind::Float, update, 3);
            set_num_threads(0);
            assert!(expected.iter().zip(&found).all(|(a, b)| a.equal(b)), "{threads} threads");
        }
    }
}
