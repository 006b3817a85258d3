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

/// Values of one rank that decide how a step goes on, or their sums over all ranks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct StepSync {
    /// Number of ranks that were asked to stop.
    stop_requests: f64,
    /// Number of ranks that found bad data.
    bad_data_reports: f64,
    /// Number of gradients.
    gradients: f64,
    /// Square of the number of gradients of each rank. The two sums show whether all ranks have the same number.
    squared_gradients: f64,
}

impl StepSync {
    const COUNT: usize = 4;

    /// Returns the values of one rank, which has computed `gradients` gradients.
    pub fn of_rank(is_asked_to_stop: bool, has_bad_data: bool, gradients: usize) -> Self {
        let gradients = gradients as f64;
        StepSync {
            stop_requests: f64::from(is_asked_to_stop),
            bad_data_reports: f64::from(has_bad_data),
            gradients,
            squared_gradients: gradients * gradients,
        }
    }

    /// Returns `true` if a rank was asked to stop.
    pub fn is_asked_to_stop(&self) -> bool {
        self.stop_requests > 0.
    }

    /// Returns `true` if a rank found bad data.
    pub fn has_bad_data(&self) -> bool {
        self.bad_data_reports > 0.
    }

    /// Returns `true` if all `ranks` ranks have the same number of gradients, the only case in which (Σ n)² = ranks · Σ n².
    pub fn has_equal_gradients(&self, ranks: usize) -> bool {
        self.gradients * self.gradients == self.squared_gradients * ranks as f64
    }

    /// Returns the tensor that is summed over all ranks: the packed `losses`, then these values, in float64 on the device of `losses`.
    pub fn to_tensor(self, losses: Tensor) -> Tensor {
        let StepSync { stop_requests, bad_data_reports, gradients, squared_gradients } = self;
        let numbers: [f64; Self::COUNT] = [stop_requests, bad_data_reports, gradients, squared_gradients];
        // Filling a new tensor on a GPU doesn't wait for the GPU.
        let numbers = numbers.map(|number| Tensor::full([1], number, (Kind::Double, losses.device())));
        Tensor::cat(&std::iter::once(losses).chain(numbers).collect::<Vec<_>>(), 0)
    }

    fn from_numbers(numbers: [f64; Self::COUNT]) -> Self {
        let [stop_requests, bad_data_reports, gradients, squared_gradients] = numbers;
        StepSync { stop_requests, bad_data_reports, gradients, squared_gradients }
    }
}

/// Sums of a step over all ranks, on the host.
#[derive(Debug)]
pub(super) struct StepSums {
    pub losses: Losses<f64>,
    pub sync: StepSync,
    /// Norm of the summed gradients.
    pub gradient_norm: f64,
}

impl StepSums {
    /// Reads `sums`, the sum of the tensors of [`StepSync::to_tensor`], and the gradient's norm, a scalar. They are copied from a GPU
    /// together, because every copy waits for all of the GPU's work; this is the only copy of a step.
    pub fn from_tensors(sums: &Tensor, gradient_norm: &Tensor) -> Self {
        let all = Tensor::cat(&[sums, &gradient_norm.to_kind(Kind::Double).view([1])], 0);
        let numbers = Vec::<f64>::try_from(all.to_device(Device::Cpu)).expect("float64");
        let (losses, rest) = numbers.split_first_chunk().expect("all terms");
        let (sync, rest) = rest.split_first_chunk().expect("all values of StepSync");
        let [gradient_norm] = rest.try_into().expect("the norm");
        StepSums { losses: Losses::unpacked(losses), sync: StepSync::from_numbers(*sync), gradient_norm }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the sums of the tensors of several ranks, as an all-reduce does.
    fn sums(ranks: &[StepSync]) -> StepSums {
        let losses = || Tensor::arange(Losses::COUNT as i64, (Kind::Double, Device::Cpu));
        let tensors: Vec<Tensor> = ranks.iter().map(|sync| sync.to_tensor(losses())).collect();
        let sum = Tensor::stack(&tensors, 0).sum_dim_intlist(0i64, false, None::<Kind>);
        StepSums::from_tensors(&sum, &Tensor::from(2.5f32))
    }

    #[test]
    fn one_rank_decides_for_all() {
        let idle = StepSync::of_rank(false, false, 7);
        for (stops, has_bad_data) in [(false, false), (true, false), (false, true), (true, true)] {
            let found = sums(&[idle, StepSync::of_rank(stops, has_bad_data, 7), idle]).sync;
            assert_eq!((found.is_asked_to_stop(), found.has_bad_data()), (stops, has_bad_data));
            assert!(found.has_equal_gradients(3));
        }
        let other = StepSync::of_rank(false, false, 8);
        assert!(!sums(&[idle, other, idle]).sync.has_equal_gradients(3));
    }
}
