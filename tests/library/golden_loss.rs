//! Loss terms against golden tensors, values and gradients.

use crate::common::{golden, largest_error, relative_error};
use globalsplat::data::ViewBatch;
use globalsplat::io::read_weights;
use globalsplat::loss::{frustum, sh_soft_cap};
use tch::{Device, Kind, Tensor};

/// Returns the size of the images of the golden cameras: the file doesn't contain it, but the principal points determine it.
fn image_size(intrinsics: &Tensor) -> i64 {
    (intrinsics.double_value(&[0, 0, 0, 2]) * 2.).round() as i64
}

#[test]
fn the_frustum_loss_matches() {
    let Some(golden) = golden() else { return };
    let golden = read_weights(&golden.join("frustum_loss.safetensors")).expect("a golden file").tensors;
    let size = image_size(&golden["intrinsic"]);
    let views = ViewBatch {
        images: Tensor::zeros([2, 4, 3, size, size], (Kind::Float, Device::Cpu)),
        masks: None,
        depths: None,
        c2w: golden["w2c"].inverse(),
        w2c: golden["w2c"].shallow_clone(),
        intrinsics: golden["intrinsic"].shallow_clone(),
    };
    let means = golden["means"].copy().set_requires_grad(true);
    let loss = frustum(&means, &views, &golden["max_depth"]);
    assert!(largest_error(&loss.view([1]), &golden["loss"]) < 1e-5 * golden["loss"].double_value(&[0]));
    loss.backward();
    assert!(relative_error(&means.grad(), &golden["grad_means"]) < 1e-4);
}

#[test]
fn the_soft_cap_of_spherical_harmonics_matches() {
    let Some(golden) = golden() else { return };
    let golden = read_weights(&golden.join("sh_softcap.safetensors")).expect("a golden file").tensors;
    let sh = golden["sh"].copy().set_requires_grad(true);
    let loss = sh_soft_cap(&sh);
    assert!(relative_error(&loss.view([1]), &golden["reg"]) < 1e-5);
    loss.backward();
    assert!(relative_error(&sh.grad(), &golden["grad"]) < 1e-4);
}
