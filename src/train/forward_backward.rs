//! Forward and backward pass of a slice of a step, module by module.
//!
//! Each module's inputs are the previous module's outputs, detached and with gradients required. Its backward pass starts from the
//! gradients of its detached outputs. So the activations of a module are freed before the backward pass of the previous module starts, the
//! encoder can recompute its rounds instead of storing them, and each module can be timed.

use crate::config::Config;
use crate::data::Batch;
use crate::device::Stopwatch;
use crate::error::Result;
use crate::loss::{PerceptualLoss, StepFraction, depth_pixels, losses};
use crate::model::{GlobalSplat, Stage, backward_from_grads, leaf};
use crate::ranks::ProcessGroup;
use crate::render::{DEFAULT_EPS2D, RenderOutput, render};
use tch::{Tensor, no_grad};

/// Inputs that all slices of a step share.
#[derive(Debug)]
pub(super) struct ForwardBackward<'a> {
    pub config: &'a Config,
    pub model: &'a GlobalSplat,
    pub perceptual: Option<&'a PerceptualLoss>,
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
            backward_from_grads(&[
                (&rgb, &rendered.rgb),
                (&alpha, &rendered.alpha),
                (&depth, &rendered.depth),
            ]);
        });
        stopwatch.time("decoder backward", || backward_from_grads(&decoded.zip_tensors(&decoded_leaves)));
        stopwatch.time("encoder backward", || {
            backward_from_grads(&encoded.zip_tensors(&encoded_leaves));
            if let Some(kept) = kept {
                kept.backward();
            }
        });
        stopwatch
            .time("tokens backward", || backward_from_grads(&[(&tokens.centered, &tokens_leaf.centered)]));
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
