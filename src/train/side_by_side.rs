//! Slices of a step side by side, each on threads of its own.
//!
//! Operations of a small network are too short to share among threads: with two a scene takes hardly less time than with one. Scenes
//! don't need each other before their gradients are added up, so each thread may have its own.

use super::forward_backward::ForwardBackward;
use crate::data::Sample;
use crate::error::Result;
use crate::loss::Share;
use crate::model::GlobalSplat;
use crate::optim::{Stopwatch, forget_gradients};
use crate::ranks::Group;
use std::panic::resume_unwind;
use std::thread::{self, ScopedJoinHandle};
use tch::{Kind, Tensor, nn, no_grad};

/// The model once more, with the same weights in the same memory, and leaves of its own for gradients to come to. So those of a step are
/// added up in the order of its scenes, whichever is done first, and the sums have the same bits every time.
#[derive(Debug)]
pub(super) struct Twin {
    model: GlobalSplat,
    /// The trained variables of the model, and those of this one beside them.
    leaves: Vec<(Tensor, Tensor)>,
}

impl Twin {
    /// Of `model`, whose variables are those of `vs`.
    ///
    /// # Errors
    /// None that the model didn't have.
    pub fn of(model: &GlobalSplat, vs: &nn::VarStore) -> Result<Self> {
        let mut own = nn::VarStore::new(vs.device());
        let twin = GlobalSplat::to_be_filled(&mut own, model.config(), model.precision())?;
        let variables = vs.variables();
        let leaves = own.variables().into_iter().filter_map(|(name, mut leaf)| {
            let variable = variables[&name].shallow_clone();
            no_grad(|| leaf.set_data(&variable.detach()));
            variable.requires_grad().then_some((variable, leaf))
        });
        Ok(Twin { leaves: leaves.collect(), model: twin })
    }

    /// Adds the gradients that came to the leaves to those of the model's own variables, and forgets them.
    fn hand_over(&self) {
        for (variable, leaf) in &self.leaves {
            let gradient = leaf.grad();
            if gradient.defined() {
                let _ = variable.grad().g_add_(&gradient);
            }
        }
        forget_gradients(self.leaves.iter().map(|(_, leaf)| leaf));
    }
}

/// What [`ForwardBackward::gradients`] does of each of `slices`, which share libtorch's threads out: of the first on this thread, of each
/// other by a twin. There are no more of them than threads, and a twin for each but the first. `watch` hears of the first, and of the
/// time for which others are waited for.
///
/// # Errors
/// A picture that can't be made.
pub(super) fn gradients_side_by_side(
    part: &ForwardBackward,
    twins: &mut [Twin],
    slices: Vec<(Sample, Share)>,
    watch: &mut Stopwatch,
) -> Result<Tensor> {
    let threads = tch::get_num_threads();
    let each = threads / slices.len() as i32;
    let (config, stage) = (part.config, part.stage);
    let mut slices = slices.into_iter();
    let (sample, share) = slices.next().expect("a slice");
    let losses: Vec<Result<Tensor>> = thread::scope(|scope| {
        let others: Vec<_> = slices
            .zip(twins.iter_mut())
            .map(|((sample, share), twin)| {
                scope.spawn(move || {
                    tch::set_num_threads(each);
                    let (model, group) = (&twin.model, &Group::alone());
                    let part = ForwardBackward { config, model, perceptual: None, stage, group };
                    part.gradients(&sample, &share, &mut Stopwatch::default())
                })
            })
            .collect();
        tch::set_num_threads(each);
        let first = part.gradients(&sample, &share, watch);
        let joined = |other: ScopedJoinHandle<_>| other.join().unwrap_or_else(|panic| resume_unwind(panic));
        watch.time("other scenes", || std::iter::once(first).chain(others.into_iter().map(joined)).collect())
    });
    // A thread that sets its number sets that of new threads, too.
    tch::set_num_threads(threads);
    let count = losses.len();
    let losses: Vec<Tensor> = losses.into_iter().collect::<Result<_>>()?;
    watch.time("adding up", || twins[..count - 1].iter().for_each(Twin::hand_over));
    Ok(Tensor::stack(&losses, 0).sum_dim_intlist(0i64, false, None::<Kind>))
}
