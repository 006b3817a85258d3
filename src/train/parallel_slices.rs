//! Parallel computation of the slices of a training step, each on its own threads.
//!
//! Operations of a small network are too short to be split among threads: two threads are hardly faster than one on the same scene. But
//! scenes are independent until their gradients are summed, so slices of different scenes can run at the same time.

use super::forward_backward::ForwardBackward;
use crate::data::Batch;
use crate::device::Stopwatch;
use crate::error::Result;
use crate::loss::StepFraction;
use crate::model::GlobalSplat;
use crate::optim::zero_grad;
use crate::ranks::ProcessGroup;
use std::panic::resume_unwind;
use std::thread::{self, ScopedJoinHandle};
use tch::{Kind, Tensor, nn, no_grad};

/// Copy of the model that shares the weights' memory and has separate gradients. [`gradients_in_parallel`] adds them to the model's
/// gradients in the order of the slices, whichever thread finishes first. So the sums are bit-identical in every run.
#[derive(Debug)]
pub(super) struct ModelReplica {
    model: GlobalSplat,
    /// Pairs of a trained variable of the model and the copy's variable that shares its memory.
    variables: Vec<(Tensor, Tensor)>,
}

impl ModelReplica {
    /// Creates a copy of `model`, whose variables are those of `vs`.
    ///
    /// # Errors
    /// Returns an error if the model can't be built. This is not expected, because `model` was built with the same configuration.
    pub fn new(model: &GlobalSplat, vs: &nn::VarStore) -> Result<Self> {
        let mut replica_vs = nn::VarStore::new(vs.device());
        let replica = GlobalSplat::uninitialized(&mut replica_vs, model.config(), model.precision())?;
        let variables = vs.variables();
        let pairs = replica_vs.variables().into_iter().filter_map(|(name, mut copy)| {
            let variable = variables[&name].shallow_clone();
            no_grad(|| copy.set_data(&variable.detach()));
            variable.requires_grad().then_some((variable, copy))
        });
        Ok(ModelReplica { variables: pairs.collect(), model: replica })
    }

    /// Adds the gradients of the copy to those of the model, and clears the gradients of the copy.
    fn accumulate_gradients(&self) {
        for (variable, copy) in &self.variables {
            let gradient = copy.grad();
            if gradient.defined() {
                let _ = variable.grad().g_add_(&gradient);
            }
        }
        zero_grad(self.variables.iter().map(|(_, copy)| copy));
    }
}

/// Computes [`ForwardBackward::gradients`] of all `slices` in parallel and returns the sum of their losses. This thread computes the first
/// slice with `forward_backward`. Each other slice is computed by a new thread with one of `replicas`, of which there must be enough. The
/// slices share libtorch's threads equally, so there must be at most as many slices as threads. `stopwatch` records the sections of the
/// first slice and the time of waiting for the other slices.
///
/// # Errors
/// Returns an error if rendering fails.
pub(super) fn gradients_in_parallel(
    forward_backward: &ForwardBackward,
    replicas: &mut [ModelReplica],
    slices: Vec<(Batch, StepFraction)>,
    stopwatch: &mut Stopwatch,
) -> Result<Tensor> {
    let threads = tch::get_num_threads();
    let each = threads / slices.len() as i32;
    let (config, stage) = (forward_backward.config, forward_backward.stage);
    let mut slices = slices.into_iter();
    let (batch, fraction) = slices.next().expect("a slice");
    let losses: Vec<Result<Tensor>> = thread::scope(|scope| {
        let others: Vec<_> = slices
            .zip(replicas.iter_mut())
            .map(|((batch, fraction), replica)| {
                scope.spawn(move || {
                    tch::set_num_threads(each);
                    let (model, group) = (&replica.model, &ProcessGroup::single());
                    let forward_backward = ForwardBackward { config, model, perceptual: None, stage, group };
                    forward_backward.gradients(&batch, &fraction, &mut Stopwatch::default())
                })
            })
            .collect();
        tch::set_num_threads(each);
        let first = forward_backward.gradients(&batch, &fraction, stopwatch);
        let join = |handle: ScopedJoinHandle<_>| handle.join().unwrap_or_else(|panic| resume_unwind(panic));
        stopwatch
            .time("other scenes", || std::iter::once(first).chain(others.into_iter().map(join)).collect())
    });
    // A thread's setting is also the default of the threads that start after it, so it is restored.
    tch::set_num_threads(threads);
    let count = losses.len();
    let losses: Vec<Tensor> = losses.into_iter().collect::<Result<_>>()?;
    stopwatch.time("adding up", || replicas[..count - 1].iter().for_each(ModelReplica::accumulate_gradients));
    Ok(Tensor::stack(&losses, 0).sum_dim_intlist(0i64, false, None::<Kind>))
}
