//! Parallel computation of a step's slices, each on threads of its own.
//!
//! Operations of a small network are too short to be split among threads: a scene takes hardly less time on two threads than on one. Scenes
//! are independent until their gradients are summed, so each slice of a step can have its own threads.

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

/// Copy of the model that shares its weights in memory and has gradients of its own. So the gradients of a step are summed in the order of
/// its scenes, whichever is done first, and the sums are bit-identical every time.
#[derive(Debug)]
pub(super) struct ModelReplica {
    model: GlobalSplat,
    /// Trained variables of the model, each with the copy's variable for it.
    leaves: Vec<(Tensor, Tensor)>,
}

impl ModelReplica {
    /// Creates a copy of `model`, whose variables are those of `vs`.
    ///
    /// # Errors
    /// Returns an error if the model can't be built. This is not expected, because `model` was built with the same configuration.
    pub fn new(model: &GlobalSplat, vs: &nn::VarStore) -> Result<Self> {
        let mut own = nn::VarStore::new(vs.device());
        let replica = GlobalSplat::uninitialized(&mut own, model.config(), model.precision())?;
        let variables = vs.variables();
        let leaves = own.variables().into_iter().filter_map(|(name, mut leaf)| {
            let variable = variables[&name].shallow_clone();
            no_grad(|| leaf.set_data(&variable.detach()));
            variable.requires_grad().then_some((variable, leaf))
        });
        Ok(ModelReplica { leaves: leaves.collect(), model: replica })
    }

    /// Adds the gradients of the copy to those of the model's own variables, and clears them.
    fn accumulate_gradients(&self) {
        for (variable, leaf) in &self.leaves {
            let gradient = leaf.grad();
            if gradient.defined() {
                let _ = variable.grad().g_add_(&gradient);
            }
        }
        zero_grad(self.leaves.iter().map(|(_, leaf)| leaf));
    }
}

/// Computes [`ForwardBackward::gradients`] of all `slices` in parallel and returns the sum of their losses. The slices share libtorch's
/// threads equally: this thread computes the first slice, and a new thread with a copy of the model each of the others. There must be at
/// most as many slices as threads, and a copy for each slice but the first. `stopwatch` records the time of the first slice's sections, and the
/// time of waiting for the other slices.
///
/// # Errors
/// Returns an error if rendering fails.
pub(super) fn gradients_in_parallel(
    part: &ForwardBackward,
    replicas: &mut [ModelReplica],
    slices: Vec<(Batch, StepFraction)>,
    stopwatch: &mut Stopwatch,
) -> Result<Tensor> {
    let threads = tch::get_num_threads();
    let each = threads / slices.len() as i32;
    let (config, stage) = (part.config, part.stage);
    let mut slices = slices.into_iter();
    let (sample, share) = slices.next().expect("a slice");
    let losses: Vec<Result<Tensor>> = thread::scope(|scope| {
        let others: Vec<_> = slices
            .zip(replicas.iter_mut())
            .map(|((sample, share), replica)| {
                scope.spawn(move || {
                    tch::set_num_threads(each);
                    let (model, group) = (&replica.model, &ProcessGroup::single());
                    let part = ForwardBackward { config, model, perceptual: None, stage, group };
                    part.gradients(&sample, &share, &mut Stopwatch::default())
                })
            })
            .collect();
        tch::set_num_threads(each);
        let first = part.gradients(&sample, &share, stopwatch);
        let joined = |other: ScopedJoinHandle<_>| other.join().unwrap_or_else(|panic| resume_unwind(panic));
        stopwatch
            .time("other scenes", || std::iter::once(first).chain(others.into_iter().map(joined)).collect())
    });
    // Setting the number of threads in one thread sets it for threads that start later, too.
    tch::set_num_threads(threads);
    let count = losses.len();
    let losses: Vec<Tensor> = losses.into_iter().collect::<Result<_>>()?;
    stopwatch.time("adding up", || replicas[..count - 1].iter().for_each(ModelReplica::accumulate_gradients));
    Ok(Tensor::stack(&losses, 0).sum_dim_intlist(0i64, false, None::<Kind>))
}
