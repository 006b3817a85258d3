//! Forward and backward pass of a slice of a step.

use crate::config::Config;
use crate::data::Sample;
use crate::error::Result;
use crate::loss::{Losses, PerceptualLoss, Share, depth_pixels, losses};
use crate::model::{GlobalSplat, Stage};
use crate::render::{Cameras, DEFAULT_EPS2D, render};
use std::ops::AddAssign;
use tch::{Tensor, no_grad};

/// What all slices of a step have in common.
#[derive(Debug)]
pub(super) struct Pass<'a> {
    pub config: &'a Config,
    pub model: &'a GlobalSplat,
    pub perceptual: Option<&'a PerceptualLoss>,
    pub stage: Stage,
}

/// [`Losses`] as numbers.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LossValues {
    pub total: f64,
    pub mse: f64,
    pub perceptual: f64,
    pub consistency: f64,
    pub frustum: f64,
    pub decoder: f64,
}

impl LossValues {
    fn of(losses: &Losses) -> Self {
        let value = |t: &Tensor| t.double_value(&[]);
        LossValues {
            total: value(&losses.total),
            mse: value(&losses.mse),
            perceptual: value(&losses.perceptual),
            consistency: value(&losses.consistency),
            frustum: value(&losses.frustum),
            decoder: value(&losses.decoder),
        }
    }
}

impl AddAssign for LossValues {
    fn add_assign(&mut self, other: Self) {
        self.total += other.total;
        self.mse += other.mse;
        self.perceptual += other.perceptual;
        self.consistency += other.consistency;
        self.frustum += other.frustum;
        self.decoder += other.decoder;
    }
}

impl Pass<'_> {
    /// Adds the gradient of the loss of `sample`, which is `share` of the step, to the variables' own.
    pub fn gradients(&self, sample: &Sample, share: &Share) -> Result<LossValues> {
        let context = &sample.context;
        let decoded = self.model.forward(&context.images, &context.c2w, &context.intrinsics, self.stage);
        let pictures = render(&decoded.gaussians, &Cameras::of(&sample.target), DEFAULT_EPS2D)?;
        let losses = losses(&self.config.loss, self.perceptual, sample, &decoded, &pictures, share);
        losses.total.backward();
        Ok(LossValues::of(&losses))
    }

    /// Pixels of a paired sample whose depth L_con compares, a scalar.
    pub fn depth_pixels(&self, sample: &Sample) -> Result<Tensor> {
        let context = &sample.context;
        no_grad(|| {
            let decoded = self.model.forward(&context.images, &context.c2w, &context.intrinsics, self.stage);
            let pictures = render(&decoded.gaussians, &Cameras::of(&sample.target), DEFAULT_EPS2D)?;
            let alpha = pictures.alpha.chunk(2, 0);
            Ok(depth_pixels([&alpha[0], &alpha[1]]))
        })
    }
}
