//! What a training step looks at. A sample depends on the seed and the step alone, so a run can go on from any step.

use super::batch::{ViewBatch, view_batch};
use super::capture::View;
use crate::error::{Error, Result};
use crate::scene::normalize;
use glam::DMat4;
use rand::seq::index;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::{Device, Kind, Tensor};

/// The views of one training step, B scenes.
#[derive(Debug)]
pub struct Sample {
    /// What the model sees.
    pub context: ViewBatch,
    /// What it is asked for.
    pub target: ViewBatch,
    /// Far end of the input views' frusta in each normalized scene, [B].
    pub far: Tensor,
    /// Whether the second half of the batch is the first half's scenes again, seen through other photos.
    pub paired: bool,
}

impl Sample {
    /// Every scene twice, along the batch: first with the context views at `subsets[0]`, then with those at `subsets[1]`.
    pub fn paired(&self, subsets: &[Vec<usize>; 2]) -> Self {
        let twice = |batch: &ViewBatch| ViewBatch::stack(&[batch, batch]);
        Sample {
            context: ViewBatch::stack(&[self.context.select(&subsets[0]), self.context.select(&subsets[1])]),
            target: twice(&self.target),
            far: Tensor::cat(&[&self.far, &self.far], 0),
            paired: true,
        }
    }

    /// Photos that the model sees of every scene.
    pub fn context_views(&self) -> usize {
        self.context.images.size()[1] as usize
    }
}

/// Far end of a frustum in units of the capture: these data sets have no metric scale (SPEC section 2).
const FAR: f64 = 4. * 10.;

/// Draws context and target views from captures held in memory.
#[derive(Debug)]
pub struct Sampler {
    captures: Vec<Vec<View>>,
    context_views: usize,
    target_views: usize,
    seed: u64,
}

impl Sampler {
    /// `captures` are the views that may be drawn, of each scene, in the order they were taken. A scene with fewer than
    /// `context_views` lowers that number for all, as a batch needs one.
    ///
    /// # Errors
    /// No captures, or one with fewer than two views.
    pub fn new(
        captures: Vec<Vec<View>>,
        context_views: usize,
        target_views: usize,
        seed: u64,
    ) -> Result<Self> {
        let fewest = captures.iter().map(Vec::len).min().unwrap_or(0);
        if fewest < 2 {
            return Err(Error::Request(format!(
                "training needs captures with two views or more that are not held out, found one with {fewest}"
            )));
        }
        Ok(Sampler {
            captures,
            context_views: context_views.min(fewest),
            target_views: target_views.min(fewest),
            seed,
        })
    }

    /// The `batch` scenes of `step`.
    ///
    /// # Errors
    /// Cameras that have no mean direction.
    pub fn sample(&self, step: u64, batch: usize, device: Device) -> Result<Sample> {
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        random.set_stream(step);
        // Different captures as far as there are enough.
        let count = self.captures.len();
        let mut drawn = vec![];
        while drawn.len() < batch {
            drawn.extend(index::sample(&mut random, count, count.min(batch - drawn.len())));
        }
        let scenes = drawn.into_iter().map(|capture| self.scene(capture, &mut random, device));
        let scenes = scenes.collect::<Result<Vec<_>>>()?;
        let (views, far): (Vec<_>, Vec<f64>) = scenes.into_iter().unzip();
        let (contexts, targets): (Vec<_>, Vec<_>) = views.into_iter().unzip();
        Ok(Sample {
            context: ViewBatch::stack(&contexts),
            target: ViewBatch::stack(&targets),
            far: Tensor::from_slice(&far).to_kind(Kind::Float).to_device(device),
            paired: false,
        })
    }

    /// (context, target) and the far end of the frusta.
    fn scene(
        &self,
        capture: usize,
        random: &mut impl Rng,
        device: Device,
    ) -> Result<((ViewBatch, ViewBatch), f64)> {
        let views = &self.captures[capture];
        let mut draw = |count: usize| {
            let mut drawn = index::sample(random, views.len(), count).into_vec();
            drawn.sort_unstable();
            drawn.into_iter().map(|i| &views[i]).collect::<Vec<_>>()
        };
        let (context, target) = (draw(self.context_views), draw(self.target_views));
        let poses: Vec<DMat4> = context.iter().chain(&target).map(|view| view.camera.c2w).collect();
        let normalization = normalize(&poses)?;
        let (context_poses, target_poses) = normalization.c2w.split_at(context.len());
        let views = (view_batch(&context, context_poses, device), view_batch(&target, target_poses, device));
        Ok((views, FAR / normalization.world_from_normalized.scale))
    }
}
