//! Scores of baselines that only copy context photos.

use super::photo_source::LazyPhotos;
use crate::error::Result;
use crate::metrics::{CaptureScores, score_view};
use glam::DVec3;

/// Scores of two baselines that only copy context photos, for the target views of a scene.
#[derive(Debug, Clone)]
pub struct Baselines {
    /// Scores of the nearest context photo.
    pub nearest_photo: CaptureScores,
    /// Scores of the mean of all context photos.
    pub mean_photo: CaptureScores,
}

impl Baselines {
    /// Scores the baselines on the targets of a scene. All photos have the same size, and there is at least one context photo.
    ///
    /// # Errors
    /// Fails if photos differ in size or can't be read.
    pub fn compute(scene: &str, context: &LazyPhotos, target: &LazyPhotos) -> Result<Self> {
        let mut sum = context.load(0)?.image.to_float().copy();
        for i in 1..context.len() {
            sum += context.load(i)?.image.to_float();
        }
        let mean = sum / context.len() as f64;
        let mut means = vec![];
        for i in 0..target.len() {
            let view = target.load(i)?;
            if !view.is_masked_out() {
                means.push(score_view(&mean, &view, None)?);
            }
        }
        Ok(Baselines {
            nearest_photo: nearest_context_baseline(scene, context, target)?,
            mean_photo: CaptureScores::from_views(scene, means, None),
        })
    }
}

/// Scores, for every target view, the context photo whose camera centre is nearest.
pub(super) fn nearest_context_baseline(
    scene: &str,
    context: &LazyPhotos,
    target: &LazyPhotos,
) -> Result<CaptureScores> {
    let centres = |photos: &LazyPhotos| -> Vec<DVec3> {
        photos.poses().iter().map(|pose| pose.w_axis.truncate()).collect()
    };
    let shown = centres(context);
    let mut scores = vec![];
    for (i, centre) in centres(target).into_iter().enumerate() {
        let distance = |&photo: &usize| shown[photo].distance(centre);
        let nearest = (0..shown.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        let nearest = context.load(nearest.expect("a context view"))?;
        let view = target.load(i)?;
        if !view.is_masked_out() {
            scores.push(score_view(&nearest.image.to_float(), &view, None)?);
        }
    }
    Ok(CaptureScores::from_views(scene, scores, None))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::View;
    use crate::scene::{Camera, Intrinsics};
    use glam::DMat4;
    use tch::{Device, Kind, Tensor};

    #[test]
    fn baselines_are_the_nearest_photo_and_the_mean() {
        let intrinsics = Intrinsics { fx: 16., fy: 16., cx: 8., cy: 8. };
        let view = |at: f64, grey: f64| View {
            name: String::new(),
            image: Tensor::full([3, 16, 16], grey, (Kind::Float, Device::Cpu)).into(),
            mask: None,
            camera: Camera { intrinsics, c2w: DMat4::from_translation(DVec3::X * at), width: 8, height: 8 },
        };
        let photos = LazyPhotos::Loaded;
        let (context, target) = (photos(vec![view(0., 0.2), view(1., 0.6)]), photos(vec![view(0.7, 0.7)]));
        let baselines = Baselines::compute("", &context, &target).unwrap();
        assert!((baselines.nearest_photo.mean.psnr - 20.).abs() < 1e-4, "0.1 apart");
        assert!((baselines.mean_photo.mean.psnr - 20. * (1f64 / 0.3).log10()).abs() < 1e-4, "0.3 apart");
    }
}
