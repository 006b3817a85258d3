//! A scene is normalized to several scales and positions, and the splat that matches the photos best is kept (spec 9.9).

use crate::common::program::{arg, refuse, succeed, tiny_config};
use crate::common::room::write_room;
use globalsplat::data::{Holdout, View, open_capture};
use globalsplat::loss::{mse, psnr_of_mse};
use globalsplat::reconstruct::{LoadedModel, Reconstruction, bundled_model, load_context, reconstruct};
use globalsplat::render::render_views;
use globalsplat::scene::{Placement, Similarity};
use serde_json::Value;
use std::path::Path;
use tch::Device;

/// Returns photos of a small room, at the model's image size.
fn photos_of(room: &Path, model: &LoadedModel) -> Vec<View> {
    write_room(room, 3, 6, [96, 96].into()).unwrap();
    let capture = open_capture(room).unwrap();
    load_context(&capture, Holdout::None, None, model.config.data.image_size).unwrap()
}

/// Reconstructs `photos` normalized to `extents`; the photos are also the targets.
fn reconstruct_at_scales(photos: &[View], model: &mut LoadedModel, extents: &[f64]) -> Reconstruction {
    model.config.data.scene_scales = extents.to_vec();
    let targets: Vec<_> = photos.iter().map(|photo| photo.camera.c2w).collect();
    reconstruct(&*model, photos, &targets).unwrap()
}

/// Returns the PSNR of the splat in world coordinates, rendered from the capture's own cameras.
fn psnr(made: &Reconstruction, photos: &[View]) -> f64 {
    let cameras: Vec<_> = photos.iter().map(|photo| photo.camera).collect();
    let pictures = render_views(&made.in_world(), &cameras).unwrap();
    let errors = pictures
        .iter()
        .zip(photos)
        .map(|(made, photo)| mse(&made.rgb, &photo.image.to_float()).double_value(&[]));
    psnr_of_mse(errors.sum::<f64>() / photos.len() as f64)
}

#[test]
fn the_splat_that_shows_the_photos_best_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let mut model = bundled_model(Device::Cpu).unwrap();
    let photos = photos_of(folder.path(), &model);
    let extents = [0.2, 0.5, 1., 2., 5.];
    let alone = extents.map(|extent| {
        let made = reconstruct_at_scales(&photos, &mut model, &[extent]);
        assert_eq!(made.placement, Placement { extent, forward: 0. });
        psnr(&made, &photos)
    });
    let best = (0..extents.len()).max_by(|&a, &b| alone[a].total_cmp(&alone[b])).unwrap();
    assert!(alone.iter().all(|&psnr| psnr == alone[best] || psnr < alone[best] - 0.05), "{alone:?} tell");
    for order in [[0, 1, 2, 3, 4], [4, 3, 2, 1, 0]] {
        let kept = reconstruct_at_scales(&photos, &mut model, &order.map(|i| extents[i]));
        let (placement, psnr) = (kept.placement, psnr(&kept, &photos));
        let nudged = (placement.extent / extents[best]).ln().abs();
        assert!(nudged < 0.151 && placement.forward.abs() < 0.226, "{placement:?}, {alone:?}");
        assert!(psnr > alone[best] + 0.01, "nudges help: {placement:?} has {psnr}, {alone:?}");
        // The target poses are normalized like the splat.
        assert_eq!(kept.target_poses.len(), photos.len());
        for (pose, view) in kept.target_poses.iter().zip(&photos) {
            let Similarity { rotation, translation, scale } = kept.world_from_normalized;
            let centre = scale * (rotation * pose.w_axis.truncate()) + translation;
            assert!(centre.distance(view.camera.c2w.w_axis.truncate()) < 1e-9);
        }
    }
}

#[test]
fn reconstruct_reports_the_placement() {
    let folder = tempfile::tempdir().unwrap();
    let (room, out) = (folder.path().join("room"), folder.path().join("room.ply"));
    let model = bundled_model(Device::Cpu).unwrap();
    let photos = photos_of(&room, &model);
    let arguments = ["reconstruct", "--scene", arg(&room), "--out", arg(&out)];
    let report: Value = serde_json::from_str(&succeed(&[&arguments[..], &["--json"]].concat())).unwrap();
    // Rounding differs between processes, so the search may end at another offset; it starts from the same scale.
    let Placement { extent, .. } = reconstruct(&model, &photos, &[]).unwrap().placement;
    assert!((report["extent"].as_f64().unwrap() / extent).ln().abs() < 0.302, "{report}");
    assert!(report["forward"].as_f64().unwrap().abs() < 0.226, "{report}");
    assert!(succeed(&arguments).contains("scene shown in several sizes, "));
}

#[test]
fn invalid_scene_scales_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let room = folder.path().join("room");
    write_room(&room, 3, 8, [32, 32].into()).unwrap();
    let config = tiny_config(folder.path(), &room);
    let run = folder.path().join("run");
    for (extents, found) in [("[]", "[]"), ("[1, 0]", "[1.0, 0.0]"), ("[inf]", "[inf]"), ("[nan]", "[NaN]")] {
        let set = format!("data.scene_scales={extents}");
        let error = refuse(&["train", "--config", arg(&config), "--out", arg(&run), "--set", &set]);
        let expected = format!("data.scene_scales is {found}, expected one or more numbers above 0");
        assert!(error.contains(&expected), "{error}");
    }
    assert!(!run.exists(), "nothing was begun");
}
