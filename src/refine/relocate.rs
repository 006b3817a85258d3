//! Relocation of dead Gaussians to where more are needed (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo").

use super::gaussian_params::GaussianParams;
use rand::Rng;
use rand::distr::weighted::WeightedIndex;
use rand::prelude::Distribution;
use tch::{Kind, Tensor};

/// Maximum number of copies of one Gaussian that the correction takes into account.
const MAX_COPIES: usize = 50;
/// Half of the width of the uniform distribution with a standard deviation of 1.
const UNIT_SPREAD: f32 = 1.732_050_8;
/// Minimum opacity after relocation.
const MIN_OPACITY: f64 = 0.005;

/// Exponent of a Gaussian's sensitivity in the probability that another one moves onto it.
const SENSITIVITY_POWER: f64 = 0.5;

/// Moves every Gaussian whose opacity is at most `dead` onto another one, drawn with probability proportional to its opacity and to the root
/// of its sensitivity: its size times the root of `squared_gradients`, the mean squares of the gradients of the means, [1, N, 3]. Changes the
/// opacities and scales of all Gaussians that then coincide so that together they look like the original one. Then displaces the moved
/// Gaussians within the original one, by `spread` of its standard deviations, so that they get different gradients. Returns the indices of
/// the changed Gaussians.
pub(super) fn relocate(
    params: &GaussianParams,
    squared_gradients: &Tensor,
    dead: f64,
    spread: f64,
    random: &mut impl Rng,
) -> Vec<i64> {
    let numbers = |t: Tensor| {
        Vec::<f64>::try_from(t.view([-1]).to_kind(Kind::Double)).expect("one number per Gaussian")
    };
    let [means, log_scales, quaternions, opacity_logits, ..] = &params.0;
    let opacities = numbers(opacity_logits.sigmoid());
    let (gone, alive): (Vec<usize>, Vec<usize>) = (0..opacities.len()).partition(|&i| opacities[i] <= dead);
    if gone.is_empty() || alive.is_empty() {
        return vec![];
    }
    let sizes = log_scales.mean_dim([2].as_slice(), false, Kind::Double).exp();
    let sensitivities =
        numbers(squared_gradients.sum_dim_intlist([2].as_slice(), false, Kind::Double).sqrt() * sizes);
    let weight = |&i: &usize| {
        let attraction = sensitivities[i].powf(SENSITIVITY_POWER);
        let is_usable = attraction > 0. && attraction.is_finite();
        opacities[i] * if is_usable { attraction } else { f64::MIN_POSITIVE }
    };
    let by_weight = WeightedIndex::new(alive.iter().map(weight)).expect("some are above 0");
    let sources: Vec<usize> = gone.iter().map(|_| alive[by_weight.sample(random)]).collect();
    let mut copies = vec![1usize; opacities.len()];
    sources.iter().for_each(|&source| copies[source] += 1);
    let mut changed: Vec<usize> = (0..copies.len()).filter(|&i| copies[i] > 1).collect();
    let (mut logits, mut shrink) = (vec![], vec![]);
    for &i in &changed {
        let n = copies[i].min(MAX_COPIES);
        let opacity = 1. - (1. - opacities[i]).powf(1. / n as f64);
        shrink.push((opacities[i] / integral(opacity, n)).ln() as f32);
        let opacity = opacity.clamp(MIN_OPACITY, 1. - 1e-6);
        logits.push((opacity / (1. - opacity)).ln() as f32);
    }
    let device = means.device();
    let index = |of: &[usize]| {
        Tensor::from_slice(&of.iter().map(|&i| i as i64).collect::<Vec<_>>()).to_device(device)
    };
    let tensor = |of: &[f32]| Tensor::from_slice(of).to_device(device);
    let (to, from, at) = (index(&gone), index(&sources), index(&changed));
    tch::no_grad(|| {
        let count = changed.len() as i64;
        let _ = opacity_logits.shallow_clone().index_copy_(1, &at, &tensor(&logits).view([1, count]));
        let smaller = log_scales.index_select(1, &at) + tensor(&shrink).view([1, count, 1]);
        let _ = log_scales.shallow_clone().index_copy_(1, &at, &smaller);
        for tensor in &params.0 {
            let _ = tensor.shallow_clone().index_copy_(1, &to, &tensor.index_select(1, &from));
        }
        let offsets: Vec<f32> =
            (0..3 * gone.len()).map(|_| random.random_range(-UNIT_SPREAD..UNIT_SPREAD)).collect();
        let offsets = tensor(&offsets).view([1, -1, 3]) * log_scales.index_select(1, &to).exp() * spread;
        let moved = rotate(&quaternions.index_select(1, &to), &offsets);
        let _ = means.shallow_clone().index_add_(1, &to, &moved);
    });
    changed.extend(gone);
    changed.into_iter().map(|i| i as i64).collect()
}

/// Rotates `vectors` [1, N, 3] by `quaternions` [1, N, 4] of any length.
fn rotate(quaternions: &Tensor, vectors: &Tensor) -> Tensor {
    let length = quaternions.square().sum_dim_intlist([2].as_slice(), true, Kind::Float).sqrt();
    let unit = quaternions / length;
    let (w, axis) = (unit.narrow(2, 0, 1), unit.narrow(2, 1, 3));
    let twice = axis.cross(vectors, 2) * 2.;
    vectors + &twice * w + axis.cross(&twice, 2)
}

/// Returns the integral of the opacity along a line through the center of n coincident Gaussians of one opacity, in units of the standard
/// deviation times √(2π) (eq. 9 of the paper).
fn integral(opacity: f64, n: usize) -> f64 {
    let mut sum = 0.;
    for i in 1..=n {
        let mut binomial = 1.; // (i − 1 choose k)
        for k in 0..i {
            let sign = if k % 2 == 0 { 1. } else { -1. };
            sum += binomial * sign * opacity.powi(k as i32 + 1) / ((k + 1) as f64).sqrt();
            binomial *= (i - 1 - k) as f64 / (k + 1) as f64;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::RawGaussians;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// Several coincident Gaussians, with their reduced opacity and scale, occlude as much along a line as the original one.
    #[test]
    fn copies_look_like_the_one() {
        let hidden = |opacity: f64, extent: f64, copies: i32| {
            let step = 1e-3;
            let alpha = |x: f64| opacity * (-0.5 * (x / extent).powi(2)).exp();
            (-20_000..20_000)
                .map(|i| (1. - (1. - alpha(f64::from(i) * step)).powi(copies)) * step)
                .sum::<f64>()
        };
        for (opacity, copies) in [(0.7, 1), (0.7, 2), (0.95, 3), (0.2, 7)] {
            let fainter = 1f64 - (1f64 - opacity).powf(1. / f64::from(copies));
            let smaller = opacity / integral(fainter, copies as usize);
            let (one, all) = (hidden(opacity, 1., 1), hidden(fainter, smaller, copies));
            assert!((one - all).abs() < 1e-6, "{opacity}, {copies}: {one} and {all}");
        }
    }

    /// Relocates the first four of ten Gaussians in a row, which are dead, with the squared gradients of `[10, 3]` means. Returns means, scales
    /// and opacity logits, and the changed Gaussians.
    fn relocated(squared_gradients: &Tensor, spread: f64) -> ([Tensor; 3], Vec<i64>) {
        let options = (Kind::Float, tch::Device::Cpu);
        let logits: Vec<f32> = (0..10).map(|i| if i < 4 { -8. } else { 2. }).collect();
        let raw = RawGaussians {
            means: Tensor::arange(30, options).view([1, 10, 3]),
            log_scales: Tensor::from_slice(&[-3f32, -4., -5.]).expand([1, 10, 3], false).contiguous(),
            // A quarter turn about z, at twice the length.
            quaternions: Tensor::from_slice(&[1f32, 0., 0., 1.]).expand([1, 10, 4], false).contiguous(),
            opacity_logits: Tensor::from_slice(&logits).view([1, 10]),
            sh: Tensor::zeros([1, 10, 1, 3], options),
        };
        let params = GaussianParams::from_raw(&raw, 0);
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let changed = relocate(&params, &squared_gradients.unsqueeze(0), 0.01, spread, &mut random);
        let none = relocate(&params, &squared_gradients.unsqueeze(0), 0.01, spread, &mut random);
        assert!(none.is_empty(), "none are dead any more");
        let [means, log_scales, _, logits, ..] = params.0;
        ([means.detach().get(0), log_scales.detach().exp().get(0), logits.detach().get(0)], changed)
    }

    fn zeros() -> Tensor {
        Tensor::zeros([10, 3], (Kind::Float, tch::Device::Cpu))
    }

    #[test]
    fn dead_gaussians_go_where_others_are() {
        let ([means, _, logits], mut changed) = relocated(&zeros(), 0.);
        for dead in 0..4 {
            let source = (4..10).find(|&source| means.get(dead).equal(&means.get(source))).expect("a source");
            assert!(changed.contains(&source) && changed.contains(&dead));
            let logit = |index: i64| logits.double_value(&[index]);
            assert!(logit(dead) == logit(source) && logit(source) < 2.);
        }
        changed.sort_unstable();
        assert!(changed.is_sorted_by(|a, b| a < b), "each once");
    }

    #[test]
    fn gaussians_move_onto_sensitive_ones() {
        // The root of the sensitivity of the last is a million times that of the others.
        let gradients = zeros() + 1e-24;
        let _ = gradients.get(9).fill_(1.);
        // One whose gradients have overflowed attracts nothing.
        let _ = gradients.get(8).fill_(f64::INFINITY);
        let ([means, ..], _) = relocated(&gradients, 0.);
        assert!((0..4).all(|dead| means.get(dead).equal(&means.get(9))), "{means:?}");
    }

    #[test]
    fn moved_gaussians_are_spread_within_the_original_one() {
        let [([together, scales, _], _), ([apart, ..], _)] =
            [0., 0.5].map(|spread| relocated(&zeros(), spread));
        let moved = (apart - together).abs();
        assert_eq!(moved.narrow(0, 4, 6).max().double_value(&[]), 0.);
        // The turn exchanges x and y. Coordinates up to 30 are rounded to 2e-6.
        for (dead, (axis, own)) in (0..4).flat_map(|dead| [(0, 1), (1, 0), (2, 2)].map(|axes| (dead, axes))) {
            let most = 0.5 * f64::from(UNIT_SPREAD) * scales.double_value(&[dead, own]) + 4e-6;
            let shift = moved.double_value(&[dead, axis]);
            assert!(0. < shift && shift < most, "{dead}, {axis}: {shift} of {most}");
        }
    }
}
