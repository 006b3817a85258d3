//! Preview image of the training progress.

use crate::data::Batch;
use crate::error::Result;
use crate::io::tile_horizontally;
use crate::model::{GlobalSplat, Stage};
use crate::render::{DEFAULT_EPS2D, colourize_depth, render};
use tch::{Device, Tensor};

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
    let grey = alpha.unsqueeze(0).expand([3, -1, -1], false);
    Ok(tile_horizontally(&[photo, ground_truth, rgb.clamp(0., 1.), colourize_depth(&depth, &alpha), grey]))
}
