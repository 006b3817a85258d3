//! Reports of a training step and of a validation, and the sums over all ranks that a step makes in addition to those of the gradients.

use crate::data::Batch;
use crate::error::Result;
use crate::io::tile_horizontally;
use crate::loss::{Losses, Term, psnr_of_mse};
use crate::model::{GlobalSplat, Stage};
use crate::render::{DEFAULT_EPS2D, colorize_depth, render};
use tch::{Device, Kind, Tensor};

/// Report of a training step.
#[derive(Debug)]
pub struct StepReport {
    /// Step, counted from 0.
    pub step: u64,
    /// Curriculum stage.
    pub stage: Stage,
    /// Learning rate.
    pub learning_rate: f64,
    /// Loss and its terms.
    pub losses: Losses<f64>,
    /// Norm of the gradient, before clipping.
    pub gradient_norm: f64,
    /// `true` if loss or gradient wasn't finite, so that no weights were changed.
    pub skipped: bool,
    /// Names of the scenes of this rank, or of all ranks if the step was skipped.
    pub scenes: Vec<String>,
    /// Preview of the first scene before the step, `[3, H, W]`, at the steps that `train.log_images_every` selects.
    pub picture: Option<Tensor>,
    /// `true` if no rank was asked to stop.
    pub should_continue: bool,
}

impl StepReport {
    /// Returns the PSNR of all rendered images together, in dB.
    pub fn psnr(&self) -> f64 {
        psnr_of_mse(self.losses[Term::Mse])
    }
}

/// Renders a preview of the first scene of `batch`, which isn't paired: a context photo, a target photo, its rendered image, its depth
/// and its accumulated opacity, side by side, `[3, H, W']` in [0, 1] on the CPU.
pub(super) fn preview(model: &GlobalSplat, batch: &Batch, stage: Stage) -> Result<Tensor> {
    let Batch { context, target, .. } = batch.slice(0, 1);
    let middle = |views: &Tensor| views.size()[1] as usize / 2;
    let (shown, target) =
        (context.select(&[middle(&context.images)]), target.select(&[middle(&target.images)]));
    let pictures = tch::no_grad(|| {
        let decoded = model.forward(&context.model_input(), stage);
        render(&decoded.gaussians, &target.cameras(), DEFAULT_EPS2D)
    })?;
    let first = |t: &Tensor| t.select(0, 0).select(0, 0).to_device(Device::Cpu);
    let (photo, ground_truth, rgb) = (first(&shown.images), first(&target.images), first(&pictures.rgb));
    let (depth, alpha) = (first(&pictures.depth), first(&pictures.alpha));
    let gray = alpha.unsqueeze(0).expand([3, -1, -1], false);
    Ok(tile_horizontally(&[photo, ground_truth, rgb.clamp(0., 1.), colorize_depth(&depth, &alpha), gray]))
}

/// Mean scores over all held-out views or scenes.
#[derive(Debug, Clone, PartialEq)]
pub struct Score {
    /// Mean PSNR over the scenes, in dB.
    pub psnr: f64,
    /// Mean SSIM over the scenes.
    pub ssim: f64,
    /// Number of scenes.
    pub scenes: usize,
    /// Stage at which the model was evaluated: the one that it has been trained to.
    pub stage: Stage,
    /// Reasons why scenes were left out, each listed once.
    pub left_out: Vec<String>,
}

/// Returns the tensor of one rank that is summed over all ranks: the packed `losses`, then the values that decide how a step goes on, in
/// float64 on the device of `losses`. The rank has computed `gradients` gradients.
pub(super) fn to_summed_tensor(
    losses: Tensor,
    is_asked_to_stop: bool,
    has_bad_data: bool,
    gradients: usize,
) -> Tensor {
    let gradients = gradients as f64;
    let [stop, bad_data] = [is_asked_to_stop, has_bad_data].map(f64::from);
    let values = [stop, bad_data, gradients, gradients * gradients];
    // Filling a new tensor on a GPU doesn't wait for the GPU.
    let values = values.map(|value| Tensor::full([1], value, (Kind::Double, losses.device())));
    Tensor::cat(&std::iter::once(losses).chain(values).collect::<Vec<_>>(), 0)
}

/// Sums of a step over all ranks, on the host.
#[derive(Debug)]
pub(super) struct StepSums {
    pub losses: Losses<f64>,
    /// `true` if a rank was asked to stop.
    pub is_asked_to_stop: bool,
    /// `true` if a rank found bad data.
    pub has_bad_data: bool,
    /// Sum of the numbers of gradients of the ranks, and of their squares.
    gradients: [f64; 2],
    /// Norm of the summed gradients.
    pub gradient_norm: f64,
}

impl StepSums {
    /// Reads `sums`, the sum of the tensors of [`to_summed_tensor`], and the gradient's norm, a scalar. They are copied from a GPU
    /// together, because every copy waits for all of the GPU's work; this is the only copy of a step.
    pub fn from_tensors(sums: &Tensor, gradient_norm: &Tensor) -> Self {
        let all = Tensor::cat(&[sums, &gradient_norm.to_kind(Kind::Double).view([1])], 0);
        let numbers = Vec::<f64>::try_from(all.to_device(Device::Cpu)).expect("float64");
        let (losses, rest) = numbers.split_first_chunk().expect("all terms");
        let [stops, bad_data, gradients, squares, gradient_norm] = *rest else { unreachable!("all values") };
        StepSums {
            losses: Losses::unpacked(losses),
            is_asked_to_stop: stops > 0.,
            has_bad_data: bad_data > 0.,
            gradients: [gradients, squares],
            gradient_norm,
        }
    }

    /// Returns `true` if all `ranks` ranks have the same number of gradients, the only case in which (Σ n)² = ranks · Σ n².
    pub fn has_equal_gradients(&self, ranks: usize) -> bool {
        let [sum, squares] = self.gradients;
        sum * sum == squares * ranks as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_rank_decides_for_all() {
        let rank = |stops: bool, has_bad_data: bool, gradients: usize| {
            let losses = Tensor::arange(Losses::COUNT as i64, (Kind::Double, Device::Cpu));
            to_summed_tensor(losses, stops, has_bad_data, gradients)
        };
        for (stops, has_bad_data, gradients) in
            [(false, false, 7), (true, false, 7), (false, true, 7), (true, true, 7), (false, false, 8)]
        {
            let sums = rank(false, false, 7) + rank(stops, has_bad_data, gradients) + rank(false, false, 7);
            let found = StepSums::from_tensors(&sums, &Tensor::from(2.5f32));
            assert_eq!((found.is_asked_to_stop, found.has_bad_data), (stops, has_bad_data));
            assert_eq!((found.has_equal_gradients(3), found.gradient_norm), (gradients == 7, 2.5));
        }
    }
}
