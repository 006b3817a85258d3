//! Scene normalization against golden tensors.

use crate::common::{golden, largest_error};
use glam::DMat4;
use globalsplat::io::read_weights;
use globalsplat::scene::{normalize, pose_to_rows};
use std::collections::BTreeMap;
use tch::{Kind, Tensor};

fn poses(t: &Tensor) -> Vec<DMat4> {
    let values = Vec::<f64>::try_from(t.to_kind(Kind::Double).flatten(0, -1)).expect("numbers");
    values.chunks_exact(16).map(|rows| DMat4::from_cols_slice(rows).transpose()).collect()
}

fn tensor(poses: &[DMat4]) -> Tensor {
    let rows: Vec<f64> = poses.iter().flat_map(pose_to_rows).collect();
    Tensor::from_slice(&rows).view([-1, 4, 4])
}

fn read() -> Option<BTreeMap<String, Tensor>> {
    let path = golden()?.join("scene_normalization.safetensors");
    Some(read_weights(&path).expect("a golden file").tensors)
}

#[test]
fn many_cameras_match() {
    let Some(golden) = read() else { return };
    let ours = normalize(&poses(&golden["c2w"])).expect("cameras");
    assert!(largest_error(&tensor(&ours.c2w), &golden["norm_c2w"]) < 1e-6);
    let w2c: Vec<DMat4> = ours.c2w.iter().map(DMat4::inverse).collect();
    assert!(largest_error(&tensor(&w2c), &golden["norm_w2c"]) < 1e-6);
    let scale = golden["scene_scale"].double_value(&[0]);
    assert!((ours.world_from_normalized.scale / scale - 1.).abs() < 1e-6);
}

#[test]
fn one_camera_matches() {
    let Some(golden) = read() else { return };
    let ours = normalize(&poses(&golden["c2w"])[..1]).expect("a camera");
    assert!(largest_error(&tensor(&ours.c2w), &golden["single_norm_c2w"]) < 1e-6);
    assert_eq!(ours.world_from_normalized.scale, golden["single_scene_scale"].double_value(&[0]));
}

#[test]
fn the_similarity_leads_back() {
    let Some(golden) = read() else { return };
    let original = poses(&golden["c2w"]);
    let ours = normalize(&original).expect("cameras");
    let s = ours.world_from_normalized;
    for (pose, before) in ours.c2w.iter().zip(&original) {
        let centre = s.scale * (s.rotation * pose.w_axis.truncate()) + s.translation;
        assert!(centre.distance(before.w_axis.truncate()) < 1e-9);
    }
}
