//! The colors of a reconstruction are fitted to its photos (spec 9.9).

use crate::common::program::Sandbox;
use crate::common::room::write_room;
use globalsplat::data::{Holdout, View, open_capture};
use globalsplat::loss::{mse, psnr_of_mse};
use globalsplat::reconstruct::{Reconstruction, bundled_model, load_context, reconstruct};
use globalsplat::render::render_views;
use globalsplat::scene::Similarity;
use tch::Device;

/// Returns the PSNR of the splat in world coordinates, rendered from the cameras of `views`.
fn psnr(reconstruction: &Reconstruction, views: &[View]) -> f64 {
    let cameras: Vec<_> = views.iter().map(|view| view.camera).collect();
    let rendered = render_views(&reconstruction.in_world(), &cameras).unwrap();
    let errors = rendered
        .iter()
        .zip(views)
        .map(|(rendered, view)| mse(&rendered.rgb, &view.image.to_float()).double_value(&[]));
    psnr_of_mse(errors.sum::<f64>() / views.len() as f64)
}

/// Photos and held-out views are reproduced better, and only the colors change.
#[test]
fn fitted_colors_show_held_out_views_better() {
    let folder = tempfile::tempdir().unwrap();
    write_room(folder.path(), 3, 8, [96, 96].into());
    let capture = open_capture(folder.path()).unwrap();
    let mut model = bundled_model(Device::Cpu).unwrap();
    assert!(model.config.data.color_steps > 0);
    let mut views = load_context(&capture, Holdout::None, None, model.config.data.image_size).unwrap();
    let held_out = [views.remove(5), views.remove(2)];
    let targets = held_out.each_ref().map(|view| view.camera.c2w);

    let fitted = reconstruct(&model, &views, &targets).unwrap();
    model.config.data.color_steps = 0;
    let plain = reconstruct(&model, &views, &targets).unwrap();
    for views in [&views[..], &held_out] {
        let (fitted, plain) = (psnr(&fitted, views), psnr(&plain, views));
        assert!(fitted > plain + 1., "{fitted:.2} dB, {plain:.2} dB before");
    }
    assert!(fitted.gaussians.means.equal(&plain.gaussians.means));
    assert!(fitted.gaussians.opacities.equal(&plain.gaussians.opacities));
    // Target poses are in the same normalized world as the splat.
    for (pose, view) in fitted.target_poses.iter().zip(&held_out) {
        let Similarity { rotation, translation, scale } = fitted.world_from_normalized;
        let center = scale * (rotation * pose.w_axis.truncate()) + translation;
        assert!(center.distance(view.camera.c2w.w_axis.truncate()) < 1e-9);
    }
}

#[test]
fn reconstruct_says_that_colors_are_fitted() {
    let report = Sandbox::new().succeed("reconstruct --scene @room --out @room.ply");
    assert!(report.contains("forward pass and fit of colors "), "{report}");
}
