//! Corrections of the photos: camera poses that are slightly off, and individual exposures. Both are learned together with the splat, with
//! a few parameters per photo.

use super::config::RefineConfig;
use super::state::{CORRECTIONS, RefineState};
use crate::data::{Pixels, View, ViewBatch};
use crate::error::Result;
use crate::optim::{Optimizer, ParameterGroup, UpdateRule};
use glam::{DMat4, DQuat, DVec3};
use serde::Serialize;
use std::collections::BTreeMap;
use tch::{Device, Kind, Tensor};

/// Final learning rates, relative to the initial ones. Single steps are noisy, and corrections are not averaged.
const FINAL_RATE: f64 = 0.2;

/// Learned pose and exposure corrections of every photo. The mean over all photos is 0 for both, as a scene that is moved or brightened as
/// a whole is the same scene.
#[derive(Debug)]
pub struct Corrections {
    /// Pose corrections, [V, 6]: rotation about the camera's center as a vector along its axis, in radians, and translation of the center
    /// in scene depths, both along the world's axes.
    poses: Option<Tensor>,
    /// Logarithms of the gains of red, green and blue, [V, 3].
    exposures: Option<Tensor>,
    optimizer: Optimizer,
    rates: Vec<f64>,
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

impl Corrections {
    /// Creates corrections without parameters, which learn nothing.
    pub fn none() -> Self {
        Corrections::new(0, false, None, 1., &RefineConfig::default(), Device::Cpu)
    }

    /// Creates corrections of `photos` photos. Poses are learned from zero if `poses` is `true`, and exposures if there are initial
    /// `exposures`, the logarithms of the gains of red, green and blue of each photo. `depth` is the depth of the scene, the unit of lengths;
    /// `device` is the device of the photos.
    ///
    /// # Panics
    /// Panics if the number of exposures isn't `photos`.
    pub fn new(
        photos: usize,
        poses: bool,
        exposures: Option<&[[f64; 3]]>,
        depth: f64,
        config: &RefineConfig,
        device: Device,
    ) -> Self {
        let options = (Kind::Float, device);
        let poses = poses.then(|| Tensor::zeros([photos as i64, 6], options).set_requires_grad(true));
        let exposures = exposures.map(|gains| {
            assert_eq!(gains.len(), photos, "an exposure for each photo");
            let gains = Tensor::from_slice(gains.as_flattened()).view([photos as i64, 3]);
            gains.to_device(device).to_kind(Kind::Float).set_requires_grad(true)
        });
        let group = |name: &str, t: &Option<Tensor>, rate: f64| {
            let parameters = vec![(name.into(), t.as_ref()?.shallow_clone())];
            Some((
                ParameterGroup { rule: UpdateRule::AdamW, parameters, learning_rate: 0., weight_decay: 0. },
                rate,
            ))
        };
        let groups =
            [group("poses", &poses, config.lr_poses), group("exposures", &exposures, config.lr_exposures)];
        let (groups, rates) = groups.into_iter().flatten().unzip();
        let optimizer = Optimizer::new(groups);
        Corrections { poses, exposures, optimizer, rates, depth }
    }

    /// Continues with the values in `state`, and with its moments if it has corrections of all kinds that are learned.
    ///
    /// # Errors
    /// Returns an error if a tensor is missing or has another shape.
    pub(super) fn load_state(&mut self, state: &RefineState) -> Result<()> {
        let tensors = state.tensors_of(CORRECTIONS);
        let mut are_all_known = true;
        for (name, value) in self.values() {
            match tensors.get(&name).filter(|t| t.size() == value.size()) {
                Some(known) => tch::no_grad(|| value.shallow_clone().copy_(known)),
                None => are_all_known = false,
            }
        }
        if are_all_known { self.optimizer.load_state(state.file(), &tensors) } else { Ok(()) }
    }

    /// Adds the values and their moments to `tensors`.
    pub(super) fn add_to_state(&self, tensors: &mut BTreeMap<String, Tensor>) {
        let all = self.values().into_iter().chain(self.optimizer.state());
        tensors.extend(all.map(|(name, t)| (format!("{CORRECTIONS}{name}"), t)));
    }

    /// Returns the values that are learned, by name.
    fn values(&self) -> Vec<(String, Tensor)> {
        let named = [("value.poses", &self.poses), ("value.exposures", &self.exposures)];
        named.into_iter().filter_map(|(name, t)| Some((name.to_string(), t.as_ref()?.detach()))).collect()
    }

    /// Returns the corrected world-to-camera matrices of the photos `which`, [1, C, 4, 4], from their uncorrected poses in `views`;
    /// differentiable.
    pub(super) fn w2c(&self, views: &ViewBatch, which: &[i64]) -> Tensor {
        let Some(poses) = &self.poses else { return views.w2c.shallow_clone() };
        let numbers = of(poses, which).unsqueeze(0);
        let (twist, shift) = (numbers.narrow(2, 0, 3), numbers.narrow(2, 3, 3) * self.depth);
        // x_camera = W Tᵀ (x − o − s), with the camera's rotation W and center o, the correction's rotation T and translation s.
        let rotation = views.w2c.narrow(2, 0, 3).narrow(3, 0, 3).matmul(&turn(&twist).transpose(2, 3));
        let center = views.c2w.narrow(2, 0, 3).narrow(3, 3, 1) + shift.unsqueeze(-1);
        let rows = Tensor::cat(&[&rotation, &-rotation.matmul(&center)], 3);
        Tensor::cat(&[&rows, &views.w2c.narrow(2, 3, 1)], 2)
    }

    /// Applies the exposures of the photos `which` to rendered images of the splat, [1, C, 3, H, W].
    pub(super) fn apply_exposures(&self, rgb: Tensor, which: &[i64]) -> Tensor {
        match &self.exposures {
            Some(exposures) => rgb * of(exposures, which).exp().view([1, -1, 3, 1, 1]),
            None => rgb,
        }
    }

    /// Returns `true` if there are any.
    pub(super) fn has_any(&self) -> bool {
        self.poses.is_some() || self.exposures.is_some()
    }

    /// Clears the gradients.
    pub(super) fn zero_grad(&mut self) {
        self.optimizer.zero_grad();
    }

    /// Updates the corrections by their gradients. `progress` goes from 0 to 1.
    ///
    /// # Errors
    /// Returns an error if a GPU fails.
    pub(super) fn step(&mut self, progress: f64) -> Result<()> {
        let left = FINAL_RATE.powf(progress);
        let rates: Vec<f64> = self.rates.iter().map(|rate| rate * left).collect();
        self.optimizer.set_learning_rates(&rates);
        self.optimizer.step()
    }

    /// Returns photo `index` with the corrected camera and with the exposure of the splat.
    pub fn apply(&self, index: usize, view: &View) -> View {
        let numbers = self.numbers(index);
        let mut camera = view.camera;
        let center = camera.c2w.w_axis.truncate() + DVec3::from_slice(&numbers[3..6]) * self.depth;
        camera.c2w = DMat4::from_quat(quaternion(&numbers)) * camera.c2w;
        camera.c2w.w_axis = center.extend(1.);
        let gain = Tensor::from_slice(&numbers[6..9]).exp().to_kind(Kind::Float).view([3, 1, 1]);
        let mask = view.mask.as_ref().map(Pixels::shallow_clone);
        let image = (view.image.to_float() / gain).into();
        View { name: view.name.clone(), image, mask, camera }
    }

    /// Returns the learned correction of each of `photos`.
    pub fn report(&self, photos: &[View]) -> Vec<Correction> {
        let report = |(index, view): (usize, &View)| {
            let numbers = self.numbers(index);
            Correction {
                photo: view.name.clone(),
                degrees: quaternion(&numbers).to_axis_angle().1.to_degrees(),
                depths: DVec3::from_slice(&numbers[3..6]).length(),
                exposure: [6, 7, 8].map(|k| numbers[k].exp()),
            }
        };
        photos.iter().enumerate().map(report).collect()
    }

    /// Returns rotation, translation and log exposure of a photo, 9 values; values that aren't learned are 0.
    fn numbers(&self, index: usize) -> Vec<f64> {
        let row = |t: &Option<Tensor>, width: usize| match t {
            Some(t) => Vec::<f64>::try_from(of(t, &[index as i64]).to_kind(Kind::Double).view([-1]))
                .expect("numbers"),
            None => vec![0.; width],
        };
        [row(&self.poses, 6), row(&self.exposures, 3)].concat()
    }
}

/// Returns the rows `which` of a parameter, minus the mean of all rows.
fn of(leaf: &Tensor, which: &[i64]) -> Tensor {
    let rows = leaf - leaf.mean_dim([0].as_slice(), true, None);
    // An index tensor would have to be copied to the device.
    Tensor::stack(&which.iter().map(|&row| rows.select(0, row)).collect::<Vec<_>>(), 0)
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

/// Returns the rotation of [`turn`] by the first three of a photo's values, as a quaternion.
fn quaternion(numbers: &[f64]) -> DQuat {
    DQuat::from_vec4((DVec3::from_slice(numbers) / 2.).extend(1.)).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::view_batch;
    use crate::scene::{Camera, Intrinsics, pose_to_rows};

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
        let learned =
            Corrections::new(3, true, Some(&[[0.; 3]; 3]), 2., &RefineConfig::default(), Device::Cpu);
        let put = |t: &Option<Tensor>, values: &[f32]| {
            tch::no_grad(|| t.as_ref().unwrap().shallow_clone().view([-1]).copy_(&Tensor::from_slice(values)))
        };
        put(
            &learned.poses,
            &[0.1, -0.2, 0.05, 0.3, 0., -0.1, 0., 0., 0.4, 0., 0.2, 0., 0.1, 0., 0., 0., 0., 0.],
        );
        put(&learned.exposures, &[0.3, 0., 0., 0., 0.6, 0., 0., 0., -0.3]);
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
