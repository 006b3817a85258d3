//! Forward and backward pass of a slice of a step, module by module.
//!
//! Each module's inputs are the previous module's outputs, detached and with gradients required. Its backward pass starts from the
//! gradients of its detached outputs. So the activations of a module are freed before the backward pass of the previous module starts, the
//! encoder can recompute its rounds instead of storing them, and each module can be timed.
//!
//! On the CPU, slices of a step are computed in parallel, each on its own threads: operations of a small network are too short to be split
//! among threads, so that two threads are hardly faster than one on the same scene. But scenes are independent until their gradients are
//! summed.

use crate::config::Config;
use crate::data::Batch;
use crate::device::Stopwatch;
use crate::distributed::ProcessGroup;
use crate::error::Result;
use crate::loss::{PerceptualNetwork, StepFraction, depth_pixels, losses};
use crate::model::{GlobalSplat, Stage, backward_from_grads, leaf};
use crate::optim::zero_grad;
use crate::render::{DEFAULT_EPS2D, RenderOutput, render};
use std::panic::resume_unwind;
use std::thread::{self, ScopedJoinHandle};
use tch::{Kind, Tensor, nn, no_grad};

/// Inputs that all slices of a step share.
#[derive(Debug)]
pub(super) struct ForwardBackward<'a> {
    pub config: &'a Config,
    pub model: &'a GlobalSplat,
    pub perceptual: Option<&'a PerceptualNetwork>,
    pub stage: Stage,
    /// Process group of the ranks that make the step together.
    pub group: &'a ProcessGroup,
}

impl ForwardBackward<'_> {
    /// Adds the gradient of the loss of `batch`, which is `share` of the step, to the gradients of the variables. Returns the loss and its
    /// terms, packed by [`Losses::packed`](crate::loss::Losses::packed).
    pub fn gradients(
        &self,
        batch: &Batch,
        share: &StepFraction,
        stopwatch: &mut Stopwatch,
    ) -> Result<Tensor> {
        let context = &batch.context;
        let model = self.model;
        let input = context.model_input();
        let warp = input.radial_warp();
        let tokens = stopwatch.time("tokens", || model.tokens(&input, warp.as_ref()));
        let tokens_leaf = tokens.leaf();
        let (encoded, kept) = stopwatch.time("encoder", || match self.config.train.checkpoint_rounds {
            true => {
                let (encoded, kept) = model.encode_checkpointed(&tokens_leaf);
                (encoded, Some(kept))
            }
            false => (model.encode(&tokens_leaf), None),
        });
        let encoded_leaves = encoded.map(leaf);
        let decoded = stopwatch.time("decoder", || model.decode(&encoded_leaves, warp.as_ref(), self.stage));
        let decoded_leaves = decoded.map(leaf);
        let cameras = batch.target.cameras();
        let RenderOutput { rgb, alpha, depth } =
            stopwatch.time("render", || render(&decoded_leaves.gaussians, &cameras, DEFAULT_EPS2D))?;
        let rendered = RenderOutput { rgb: leaf(&rgb), alpha: leaf(&alpha), depth: leaf(&depth) };
        let share = self.counted(batch, &rendered.alpha, share)?;
        let losses = stopwatch.time("losses", || {
            losses(&self.config.loss, self.perceptual, batch, &decoded_leaves, &rendered, &share)
        });

        stopwatch.time("losses backward", || losses.total.backward());
        stopwatch.time("render backward", || {
            backward_from_grads([
                (&rgb, &rendered.rgb),
                (&alpha, &rendered.alpha),
                (&depth, &rendered.depth),
            ]);
        });
        stopwatch.time("decoder backward", || {
            backward_from_grads(decoded.tensors().into_iter().zip(decoded_leaves.tensors()));
        });
        stopwatch.time("encoder backward", || {
            backward_from_grads(encoded.tensors().into_iter().zip(encoded_leaves.tensors()));
            if let Some(kept) = kept {
                kept.backward();
            }
        });
        stopwatch
            .time("tokens backward", || backward_from_grads([(&tokens.centered, &tokens_leaf.centered)]));
        Ok(losses.packed())
    }

    /// Returns `share` with the number of pixels that L_con compares on all ranks. If there is only one rank, the loss counts them itself.
    fn counted(&self, batch: &Batch, alpha: &Tensor, share: &StepFraction) -> Result<StepFraction> {
        let mut pixels = share.depth_pixels.as_ref().map(Tensor::shallow_clone);
        let compares = batch.paired && self.config.loss.consistency_depth > 0.;
        if pixels.is_none() && compares && self.group.world_size() > 1 {
            let alpha = alpha.detach().chunk(2, 0);
            let counted = depth_pixels([&alpha[0], &alpha[1]], batch.target_masks().as_ref());
            self.group.all_reduce(&counted)?;
            pixels = Some(counted);
        }
        Ok(StepFraction { depth_pixels: pixels, ..*share })
    }

    /// Returns the number of pixels of a paired sample whose depth L_con compares, as a scalar.
    pub fn depth_pixels(&self, batch: &Batch) -> Result<Tensor> {
        let context = &batch.context;
        no_grad(|| {
            let decoded = self.model.forward(&context.model_input(), self.stage);
            let rendered = render(&decoded.gaussians, &batch.target.cameras(), DEFAULT_EPS2D)?;
            let alpha = rendered.alpha.chunk(2, 0);
            Ok(depth_pixels([&alpha[0], &alpha[1]], batch.target_masks().as_ref()))
        })
    }
}

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
