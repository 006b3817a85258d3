//! Decomposition of a photo into several smaller views, each of which holds a share of its pixels (spec 9.8).

use super::pixels::Pixels;
use super::view::View;
use crate::error::{Error, Result};
use crate::scene::Camera;

/// Splits `photo` into phase² views, each with every `phase`-th row and column. Pixel (phase·i + a, phase·j + b), row and column,
/// becomes pixel (i, j) of view phase·a + b and keeps its ray.
///
/// # Errors
/// Fails if `phase` doesn't divide a side.
pub fn polyphase(photo: &View, phase: u32) -> Result<Vec<View>> {
    let Camera { intrinsics, c2w, width, height } = photo.camera;
    if [height, width].iter().any(|side| side.checked_rem(phase) != Some(0)) {
        return Err(Error::request(format!(
            "the image {} has {width}×{height} pixels, expected sides that {phase} divides",
            photo.name
        )));
    }
    let every = |dim: i64, first: u32, image: &tch::Tensor| {
        image.slice(dim, i64::from(first), None::<i64>, i64::from(phase))
    };
    let part = |pixels: &Pixels, row: u32, column: u32| {
        pixels.map(|pixels| every(2, column, &every(1, row, pixels)))
    };
    let starts = (0..phase).flat_map(|row| (0..phase).map(move |column| (row, column)));
    let view = |(row, column): (u32, u32)| View {
        name: photo.name.clone(),
        image: part(&photo.image, row, column),
        mask: photo.mask.as_ref().map(|mask| part(mask, row, column)),
        camera: Camera {
            intrinsics: intrinsics.strided(phase.into(), column.into(), row.into()),
            c2w,
            width: width / phase,
            height: height / phase,
        },
    };
    Ok(starts.map(view).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::view_batch;
    use crate::scene::{Intrinsics, plucker_rays};
    use glam::{DMat4, DVec3, EulerRot};
    use tch::{Device, Kind, Tensor};

    const PHASES: [u32; 4] = [1, 2, 3, 6];

    /// Returns a photo with an off-centre principal point and a rotated and translated camera. Its pixels are numbered.
    fn photo() -> View {
        let (width, height) = (36, 24);
        let intrinsics = Intrinsics { fx: 31.7, fy: 29.3, cx: 16.9, cy: 13.4 };
        let turned = DMat4::from_euler(EulerRot::XYZ, 0.3, -0.7, 1.9);
        let c2w = DMat4::from_translation(DVec3::new(0.4, -0.8, 0.3)) * turned;
        let image = Tensor::arange(3 * height * width, (Kind::Float, Device::Cpu)).view([3, height, width]);
        let camera = Camera { intrinsics, c2w, width: width as u32, height: height as u32 };
        View { name: "images/000.png".into(), image: image.into(), mask: None, camera }
    }

    /// Returns the view, row and column of photo pixel (`y`, `x`) for this `phase`.
    fn place(phase: usize, y: usize, x: usize) -> (usize, usize, usize) {
        (phase * (y % phase) + x % phase, y / phase, x / phase)
    }

    #[test]
    fn every_pixel_is_in_one_place_and_keeps_its_ray() {
        let photo = photo();
        let ray = |k: Intrinsics, y: usize, x: usize| {
            [(x as f64 + 0.5 - k.cx) / k.fx, (y as f64 + 0.5 - k.cy) / k.fy]
        };
        for phase in PHASES {
            let views = polyphase(&photo, phase).unwrap();
            assert_eq!(views.len() as u32, phase * phase);
            let mut seen: Vec<f32> = vec![];
            for view in &views {
                assert_eq!((view.camera.width, view.camera.height), (36 / phase, 24 / phase));
                assert_eq!(view.image.size(), [3, i64::from(24 / phase), i64::from(36 / phase)]);
                assert!(view.camera.c2w == photo.camera.c2w && view.name == photo.name);
                seen.extend(Vec::<f32>::try_from(view.image.to_float().contiguous().view(-1)).unwrap());
            }
            seen.sort_by(f32::total_cmp);
            assert!(seen.iter().enumerate().all(|(i, &value)| value == i as f32), "each pixel once");
            for (y, x) in (0..24).flat_map(|y| (0..36).map(move |x| (y, x))) {
                let (view, i, j) = place(phase as usize, y, x);
                let View { image, camera, .. } = &views[view];
                let value = image.to_float().double_value(&[1, i as i64, j as i64]);
                assert_eq!(value, photo.image.to_float().double_value(&[1, y as i64, x as i64]));
                let (found, expected) = (ray(camera.intrinsics, i, j), ray(photo.camera.intrinsics, y, x));
                let off = (0..2).map(|axis| (found[axis] - expected[axis]).abs()).fold(0., f64::max);
                assert!(off < 1e-12, "phase {phase}: the ray of ({y}, {x}) is {off} off");
            }
        }
    }

    /// The code that builds the model's image tokens computes the same rays for the views as for the photo.
    #[test]
    fn plucker_rays_match_those_of_the_photo() {
        let photo = photo();
        let rays = |views: &[View]| {
            let poses: Vec<DMat4> = views.iter().map(|view| view.camera.c2w).collect();
            let batch = view_batch(views, &poses, Device::Cpu);
            let size = batch.images.size();
            plucker_rays(&batch.c2w, &batch.intrinsics, size[3], size[4])
        };
        let expected = rays(&[photo.shallow_clone()]);
        for phase in PHASES {
            let found = rays(&polyphase(&photo, phase).unwrap());
            let p = i64::from(phase);
            // Rearrange [1, a·b, i, j, 6] to [1, 1, i·a, j·b, 6].
            let joined = found.view([p, p, 24 / p, 36 / p, 6]).permute([2, 0, 3, 1, 4]);
            let off = (joined.reshape([1, 1, 24, 36, 6]) - &expected).abs().max().double_value(&[]);
            assert!(off < 1e-6, "phase {phase}: {off}");
        }
    }

    #[test]
    fn sides_that_do_not_divide_are_refused() {
        for phase in [0, 5] {
            let error = polyphase(&photo(), phase).unwrap_err().to_string();
            let expected = format!("has 36×24 pixels, expected sides that {phase} divides");
            assert!(error.contains(&expected), "{error}");
        }
    }
}
