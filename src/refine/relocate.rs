//! Relocation of dead Gaussians to where more are needed (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo").

use super::gaussian_params::GaussianParams;
use rand::Rng;
use rand::distr::weighted::WeightedIndex;
use rand::prelude::Distribution;
use tch::{Kind, Tensor};

/// Maximum number of copies of one Gaussian that the correction takes into account.
const MAX_COPIES: usize = 50;
/// Minimum opacity after relocation.
const MIN_OPACITY: f64 = 0.005;

/// Moves every Gaussian whose opacity is at most `dead` onto another one, drawn with probability proportional to its opacity. Changes the
/// opacities and scales of all Gaussians that then coincide so that together they look like the original one. Returns the indices of the
/// changed Gaussians.
pub fn relocate(leaves: &GaussianParams, dead: f64, random: &mut impl Rng) -> Vec<i64> {
    let opacities = Vec::<f64>::try_from(leaves.opacity_logits.sigmoid().view([-1]).to_kind(Kind::Double))
        .expect("numbers");
    let (gone, alive): (Vec<usize>, Vec<usize>) = (0..opacities.len()).partition(|&i| opacities[i] <= dead);
    if gone.is_empty() || alive.is_empty() {
        return vec![];
    }
    let by_opacity = WeightedIndex::new(alive.iter().map(|&i| opacities[i])).expect("some are above 0");
    let sources: Vec<usize> = gone.iter().map(|_| alive[by_opacity.sample(random)]).collect();
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
    let device = leaves.means.device();
    let index = |of: &[usize]| {
        Tensor::from_slice(&of.iter().map(|&i| i as i64).collect::<Vec<_>>()).to_device(device)
    };
    let numbers = |of: &[f32]| Tensor::from_slice(of).to_device(device);
    let (to, from, at) = (index(&gone), index(&sources), index(&changed));
    tch::no_grad(|| {
        let count = changed.len() as i64;
        let _ = leaves.opacity_logits.shallow_clone().index_copy_(1, &at, &numbers(&logits).view([1, count]));
        let smaller = leaves.log_scales.index_select(1, &at) + numbers(&shrink).view([1, count, 1]);
        let _ = leaves.log_scales.shallow_clone().index_copy_(1, &at, &smaller);
        for (_, tensor) in leaves.named_parameters() {
            let _ = tensor.shallow_clone().index_copy_(1, &to, &tensor.index_select(1, &from));
        }
    });
    changed.extend(gone);
    changed.into_iter().map(|i| i as i64).collect()
}

/// Returns the integral of the opacity along a line through the centre of n coincident Gaussians of one opacity, in units of the standard
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

    #[test]
    fn dead_gaussians_go_where_others_are() {
        let options = (Kind::Float, tch::Device::Cpu);
        let logits: Vec<f32> = (0..10).map(|i| if i < 4 { -8. } else { 2. }).collect();
        let raw = RawGaussians {
            means: Tensor::arange(30, options).view([1, 10, 3]),
            log_scales: Tensor::full([1, 10, 3], -3., options),
            quaternions: Tensor::from_slice(&[1f32, 0., 0., 0.]).expand([1, 10, 4], false).contiguous(),
            opacity_logits: Tensor::from_slice(&logits).view([1, 10]),
            sh: Tensor::zeros([1, 10, 1, 3], options),
        };
        let leaves = GaussianParams::from_raw(&raw, 0);
        let mut changed = relocate(&leaves, 0.01, &mut ChaCha8Rng::seed_from_u64(1));
        let means: Vec<f64> = Vec::try_from(leaves.means.to_kind(Kind::Double).view([-1])).unwrap();
        for dead in 0..4 {
            let at = means[3 * dead];
            assert!(at >= 12., "Gaussian {dead} is still where it was");
            let source = (at / 3.) as usize;
            assert!(changed.contains(&(source as i64)) && changed.contains(&(dead as i64)));
            let logit = |i: usize| leaves.opacity_logits.double_value(&[0, i as i64]);
            assert!(logit(dead) == logit(source) && logit(source) < 2.);
        }
        changed.sort_unstable();
        let before = changed.len();
        changed.dedup();
        assert_eq!(changed.len(), before);
        assert!(relocate(&leaves, 0.01, &mut ChaCha8Rng::seed_from_u64(1)).is_empty());
    }
}
