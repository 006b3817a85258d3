//! Learned corrections of the photos: camera poses that are slightly off (gsplat's `pose_opt`), and exposures (its `app_opt`). Both are
//! learned together with the splat, with a few parameters per photo. Their mean over all photos is 0, as a scene that is moved or brightened
//! as a whole is the same scene.

use super::options::RefineOptions;
use super::photos::longest_side;
use super::state::RefineState;
use crate::data::{View, ViewBatch};
use crate::error::Result;
use crate::optim::{Optimizer, ParameterGroup, UpdateRule};
use glam::{DMat4, DQuat, DVec3};
use serde::Serialize;
use std::collections::BTreeMap;
use tch::{Kind, Tensor};

/// Final learning rates, relative to the initial ones. Single steps are noisy, and corrections are not averaged.
const FINAL_RATE: f64 = 0.2;

/// A row of parameters for each photo, with their optimizer.
#[derive(Debug)]
struct PhotoParams {
    name: &'static str,
    /// Parameters, [V, K].
    rows: Tensor,
    optimizer: Optimizer,
    /// Initial learning rate.
    learning_rate: f64,
}

impl PhotoParams {
    fn new(name: &'static str, rows: Tensor, learning_rate: f64) -> Self {
        let rows = rows.set_requires_grad(true);
        let parameters = vec![(name.into(), rows.shallow_clone())];
        let group = ParameterGroup { rule: UpdateRule::AdamW, parameters, learning_rate, weight_decay: 0. };
        PhotoParams { name, rows, optimizer: Optimizer::new(vec![group]), learning_rate }
    }

    /// Returns the rows of the photos `which`, minus the mean of all rows.
    fn select(&self, which: &[i64]) -> Tensor {
        let rows = &self.rows - self.rows.mean_dim([0].as_slice(), true, None);
        // An index tensor would have to be copied to the device.
        Tensor::stack(&which.iter().map(|&row| rows.select(0, row)).collect::<Vec<_>>(), 0)
    }
}

/// Corrections of all photos, of those kinds that are learned.
#[derive(Debug)]
pub(crate) struct PhotoOpt {
    /// Corrections of the cameras' poses, [V, 6]: rotation about the camera's center as a vector along its axis, in radians, and translation
    /// of the center in scene depths, both along the world's axes.
    pose_opt: Option<PhotoParams>,
    /// Logarithms of the gains of red, green and blue, [V, 3].
    exposure_opt: Option<PhotoParams>,
    /// Depth of the scene, the unit of lengths.
    depth: f64,
}

/// Learned correction of one photo.
#[derive(Debug, Clone, Serialize)]
pub struct Correction {
    /// Name of the photo in the capture.
    pub photo: String,
    /// Rotation angle of the camera, in degrees.
    pub degrees: f64,
    /// Distance that the camera moved, in scene depths.
    pub depths: f64,
    /// Ratio of the photo's red, green and blue to those of the splat.
    pub exposure: [f64; 3],
}

impl PhotoOpt {
    /// Creates corrections without parameters, which learn nothing.
    pub(crate) fn none() -> Self {
        PhotoOpt { pose_opt: None, exposure_opt: None, depth: 1. }
    }

    /// Creates corrections of `photos`. Poses are learned from zero if the options say so, and exposures if there are initial `exposures`, the
    /// logarithms of the gains of red, green and blue of each photo. `depth` is the depth of the scene.
    pub(super) fn new(
        photos: &[View],
        exposures: Option<&[[f64; 3]]>,
        depth: f64,
        options: &RefineOptions,
    ) -> Self {
        let (count, kind) = (photos.len() as i64, (Kind::Float, options.device));
        let pose_opt = options.correct_poses.then(|| {
            let learning_rate = options.lr_poses_for(longest_side(photos));
            PhotoParams::new("poses", Tensor::zeros([count, 6], kind), learning_rate)
        });
        let exposure_opt = exposures.map(|gains| {
            let gains = Tensor::from_slice(gains.as_flattened()).view([count, 3]);
            let gains = gains.to_device(options.device).to_kind(Kind::Float);
            PhotoParams::new("exposures", gains, options.lr_exposures)
        });
        PhotoOpt { pose_opt, exposure_opt, depth }
    }

    fn params_mut(&mut self) -> impl Iterator<Item = &mut PhotoParams> {
        self.pose_opt.iter_mut().chain(&mut self.exposure_opt)
    }

    /// Continues with the parameters and the moments in `state`.
    ///
    /// # Errors
    /// Returns an error if the state has no corrections of a kind that is learned.
    pub(super) fn load_state(&mut self, state: &RefineState) -> Result<()> {
        self.params_mut().try_for_each(|params| {
            let rows = state.correction(params.name, &params.rows.size())?;
            tch::no_grad(|| params.rows.copy_(rows));
            params.optimizer.load_state(&state.file, &state.corrections)
        })
    }

    /// Returns the parameters and moments with their names in a state.
    pub(super) fn state(&self) -> BTreeMap<String, Tensor> {
        let mut state = BTreeMap::new();
        for params in self.pose_opt.iter().chain(&self.exposure_opt) {
            state.extend(params.optimizer.state());
            state.insert(format!("value.{}", params.name), params.rows.detach());
        }
        state
    }

    /// Returns the corrected world-to-camera matrices of the photos `which`, [1, C, 4, 4], from their uncorrected poses in `views`;
    /// differentiable.
    pub(super) fn w2c(&self, views: &ViewBatch, which: &[i64]) -> Tensor {
        let Some(poses) = &self.pose_opt else { return views.w2c.shallow_clone() };
        let numbers = poses.select(which).unsqueeze(0);
        let (twist, shift) = (numbers.narrow(2, 0, 3), numbers.narrow(2, 3, 3) * self.depth);
        // x_camera = W Tᵀ (x − o − s), with the camera's rotation W and center o, the correction's rotation T and translation s.
        let rotation = views.w2c.narrow(2, 0, 3).narrow(3, 0, 3).matmul(&turn(&twist).transpose(2, 3));
        let center = views.c2w.narrow(2, 0, 3).narrow(3, 3, 1) + shift.unsqueeze(-1);
        let rows = Tensor::cat(&[&rotation, &-rotation.matmul(&center)], 3);
        Tensor::cat(&[&rows, &views.w2c.narrow(2, 3, 1)], 2)
    }

    /// Applies the exposures of the photos `which` to rendered images of the splat, [1, C, 3, H, W].
    pub(super) fn apply_exposures(&self, rgb: Tensor, which: &[i64]) -> Tensor {
        match &self.exposure_opt {
            Some(exposures) => rgb * exposures.select(which).exp().view([1, -1, 3, 1, 1]),
            None => rgb,
        }
    }

    /// Clears the gradients.
    pub(super) fn zero_grad(&mut self) {
        self.params_mut().for_each(|params| params.optimizer.zero_grad());
    }

    /// Updates the corrections by their gradients. `progress` goes from 0 to 1.
    ///
    /// # Errors
    /// Returns an error if a GPU fails.
    pub(super) fn step(&mut self, progress: f64) -> Result<()> {
        self.params_mut().try_for_each(|params| {
            params.optimizer.set_learning_rate(params.learning_rate * FINAL_RATE.powf(progress));
            params.optimizer.step()
        })
    }

    /// Returns the rotation of a photo's camera, the translation of its center in scene depths, and the gains of red, green and blue.
    fn correction(&self, photo: usize) -> (DQuat, DVec3, [f64; 3]) {
        let numbers = |params: &Option<PhotoParams>, first: i64| {
            let Some(params) = params else { return DVec3::ZERO };
            let row = params.select(&[photo as i64]);
            DVec3::from_array([0, 1, 2].map(|column| row.double_value(&[0, first + column])))
        };
        let rotation = DQuat::from_vec4((numbers(&self.pose_opt, 0) / 2.).extend(1.)).normalize();
        let gains = numbers(&self.exposure_opt, 0).to_array().map(f64::exp);
        (rotation, numbers(&self.pose_opt, 3), gains)
    }

    /// Returns photo `index` with the corrected camera and with the exposure of the splat.
    pub(super) fn apply(&self, index: usize, view: &View) -> View {
        let (rotation, shift, gains) = self.correction(index);
        let mut camera = view.camera;
        let center = camera.c2w.w_axis.truncate() + shift * self.depth;
        camera.c2w = DMat4::from_quat(rotation) * camera.c2w;
        camera.c2w.w_axis = center.extend(1.);
        let gains = Tensor::from_slice(&gains).to_kind(Kind::Float).view([3, 1, 1]);
        View { image: (view.image.to_float() / gains).into(), camera, ..view.shallow_clone() }
    }

    /// Returns the learned correction of each of `photos`; none if nothing is learned.
    pub(super) fn report(&self, photos: &[View]) -> Vec<Correction> {
        if self.pose_opt.is_none() && self.exposure_opt.is_none() {
            return vec![];
        }
        let report = |(index, view): (usize, &View)| {
            let (rotation, shift, exposure) = self.correction(index);
            let degrees = rotation.to_axis_angle().1.to_degrees();
            Correction { photo: view.name.clone(), degrees, depths: shift.length(), exposure }
        };
        photos.iter().enumerate().map(report).collect()
    }
}

/// Returns rotations [.., 3, 3] by 2 atan(|v|/2) about vectors v [.., 3] (Cayley): I + (K + K²/2) / (1 + |v|²/4), with K x = v × x.
fn turn(vectors: &Tensor) -> Tensor {
    let [x, y, z] = [0, 1, 2].map(|axis| vectors.select(-1, axis));
    let none = x.zeros_like();
    let row = |numbers: [&Tensor; 3]| Tensor::stack(&numbers, -1);
    let cross = Tensor::stack(&[row([&none, &-&z, &y]), row([&z, &none, &-&x]), row([&-&y, &x, &none])], -2);
    let square = vectors.square().sum_dim_intlist([-1].as_slice(), true, None).unsqueeze(-1);
    let share = (square / 4. + 1.).reciprocal();
    Tensor::eye(3, (vectors.kind(), vectors.device())) + (&cross + cross.matmul(&cross) / 2.) * share
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::view_batch;
    use crate::scene::{Camera, Intrinsics, pose_to_rows};
    use tch::Device;

    fn view(index: usize) -> View {
        let c2w = DMat4::from_rotation_translation(
            DQuat::from_euler(glam::EulerRot::XYZ, 0.3, 0.1 * index as f64, -0.2),
            DVec3::new(1., index as f64, -2.),
        );
        let intrinsics = Intrinsics { fx: 10., fy: 10., cx: 4., cy: 4. };
        let camera = Camera { c2w, intrinsics, width: 8, height: 8 };
        View {
            name: index.to_string(),
            image: Tensor::full([3, 8, 8], 0.5, (Kind::Float, Device::Cpu)).into(),
            mask: None,
            camera,
        }
    }

    /// The optimization and the reported corrections use the same cameras and colors.
    #[test]
    fn applied_corrections_match_learned_ones() {
        let views = [view(0), view(1), view(2)];
        let poses: Vec<DMat4> = views.iter().map(|view| view.camera.c2w).collect();
        let batch = view_batch(&views, &poses, Device::Cpu);
        let gains = [[0.3, 0., 0.], [0., 0.6, 0.], [0., 0., -0.3]];
        let options = RefineOptions { correct_poses: true, ..RefineOptions::default() };
        let learned = PhotoOpt::new(&views, Some(&gains), 2., &options);
        let poses =
            [[0.1f32, -0.2, 0.05, 0.3, 0., -0.1], [0., 0., 0.4, 0., 0.2, 0.], [0.1, 0., 0., 0., 0., 0.]];
        let values = Tensor::from_slice(poses.as_flattened()).view([3, 6]);
        tch::no_grad(|| learned.pose_opt.as_ref().unwrap().rows.shallow_clone().copy_(&values));
        let applied: Vec<View> =
            views.iter().enumerate().map(|(index, view)| learned.apply(index, view)).collect();
        let w2c = learned.w2c(&batch, &[0, 1, 2]);
        let images = learned.apply_exposures(batch.images.ones_like() * 0.5, &[0, 1, 2]);
        for (index, view) in applied.iter().enumerate() {
            let rows = Tensor::from_slice(&pose_to_rows(&view.camera.c2w.inverse())).view([4, 4]);
            let apart = (w2c.select(0, 0).select(0, index as i64) - rows).abs().max().double_value(&[]);
            assert!(apart < 1e-6, "camera {index} is {apart} off");
            // The photo divided by its exposure, times the rendered image multiplied by the exposure.
            let product = view.image.to_float() * images.select(0, 0).select(0, index as i64);
            assert!((product - 0.25).abs().max().double_value(&[]) < 1e-6);
        }
        let report = learned.report(&views);
        let mean: f64 = report.iter().map(|photo| photo.exposure[0].ln()).sum();
        assert!(
            mean.abs() < 1e-6
                && report[1].degrees > 10.
                && (report[1].exposure[1] - 0.4f64.exp()).abs() < 1e-6
        );
    }
}
