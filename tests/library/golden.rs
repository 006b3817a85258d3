//! The model, losses and the normalization of scenes match tensors that an independent implementation computed: outputs within 1e-5 and
//! gradients within 1e-4 relative L2.

use crate::common::{golden, largest_error, relative_error};
use glam::DMat4;
use globalsplat::data::ViewBatch;
use globalsplat::io::{Weights, read_weights};
use globalsplat::loss::{decoder_regularization, frustum, sh_soft_cap};
use globalsplat::model::{GlobalSplat, ModelConfig, ModelInput, Stage};
use globalsplat::scene::{normalize, pose_to_rows};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tch::{Device, Kind, Tensor, nn};

const OUTPUT_TOLERANCE: f64 = 1e-5;
const GRADIENT_TOLERANCE: f64 = 1e-4;
/// Name of key biases, whose gradient is zero in exact arithmetic: softmax ignores a constant. The computed values are rounding
/// errors that scale with the gradients around them, so they are compared with the case's largest gradient.
const ZERO_GRADIENT: &str = "mem_k.bias";
const ZERO_TOLERANCE: f64 = 1e-5;

/// Returns the cases, at least one; none without a golden folder.
fn cases() -> Vec<PathBuf> {
    let Some(root) = golden() else { return vec![] };
    let mut cases: Vec<PathBuf> = std::fs::read_dir(&root)
        .expect("a readable folder")
        .map(|entry| entry.expect("a readable entry").path())
        .filter(|path| path.join("config.json").is_file())
        .collect();
    assert!(!cases.is_empty(), "no case with a config.json is in {}", root.display());
    cases.sort();
    cases
}

/// Returns a case's model with its weights, and its configuration as JSON.
fn load(case: &Path) -> (nn::VarStore, GlobalSplat, serde_json::Value) {
    let json: serde_json::Value =
        serde_json::from_slice(&std::fs::read(case.join("config.json")).expect("config.json")).expect("JSON");
    let number = |key: &str| json[key].as_i64().unwrap_or_else(|| panic!("{key} in {}", case.display()));
    let config = ModelConfig {
        patch_size: number("patch_size"),
        latents: number("latent_rep_token_amount"),
        width: number("dim_latents"),
        rgb_width: number("dim_rgb_feat"),
        ray_width: number("dim_rays"),
        rounds: number("rounds"),
        self_attention_blocks: number("slot_calib_layers_per_round"),
        heads: number("num_heads"),
        candidates: number("M_max"),
        sh_degree: number("sh_degree"),
        ..Default::default()
    };
    let vs = nn::VarStore::new(Device::Cpu);
    let model = GlobalSplat::new(&vs.root(), &config).expect("a valid configuration");
    let state = case.join("state.safetensors");
    read_weights(&state).and_then(|w| w.load_into(&vs, &state)).expect("weights that fit");
    (vs, model, json)
}

fn input(tensors: &BTreeMap<String, Tensor>, images: &Tensor) -> ModelInput {
    let [images, c2w, intrinsics] =
        [images, &tensors["c2w"], &tensors["intrinsic"]].map(Tensor::shallow_clone);
    ModelInput { images, c2w, intrinsics, depths: None }
}

fn read(case: &Path, name: &str) -> Weights {
    read_weights(&case.join(format!("{name}.safetensors"))).expect("a golden file")
}

fn assert_close(what: &str, ours: &Tensor, golden: &Tensor, tolerance: f64) {
    let error = relative_error(ours, golden);
    assert!(error <= tolerance, "{what}: relative error {error:.2e}, tolerance {tolerance:.0e}");
}

#[test]
fn the_encoder_matches() {
    for case in cases() {
        let (_vs, model, _) = load(&case);
        let (inputs, golden) = (read(&case, "inputs").tensors, read(&case, "encoder").tensors);
        let encoded = model.encode(&model.tokens(&input(&inputs, &inputs["images"]), None));
        assert_close("geometry", &encoded.geometry, &golden["encoded_geo"], OUTPUT_TOLERANCE);
        assert_close("appearance", &encoded.appearance, &golden["encoded_tex"], OUTPUT_TOLERANCE);
    }
}

#[test]
fn every_stage_matches_in_values_and_gradients() {
    for case in cases() {
        let (vs, model, json) = load(&case);
        let inputs = read(&case, "inputs").tensors;
        let stages = json["stages"].as_array().filter(|stages| !stages.is_empty());
        for stage in stages.expect("stages") {
            let stage = Stage { index: stage[0].as_u64().unwrap() as u32, mix: stage[1].as_f64().unwrap() };
            let name = format!("stage{}_mix{:03}", stage.index, (stage.mix * 100.).round());
            let what = |part: &str| format!("{} {name} {part}", case.file_name().unwrap().to_string_lossy());
            let golden = read(&case, &name).tensors;

            let images = inputs["images"].copy().set_requires_grad(true);
            let decoded = model.forward(&input(&inputs, &images), stage);
            let g = &decoded.gaussians;
            let outputs = [
                ("means", g.means.shallow_clone()),
                ("scales", g.scales.shallow_clone()),
                ("rotations_6d", decoded.rotations_6d.shallow_clone()),
                ("quats_wxyz", g.quaternions.shallow_clone()),
                ("opacities", g.opacities.unsqueeze(-1)),
                ("sh", g.sh.shallow_clone()),
                ("reg", decoder_regularization(&decoded.raw, false).total.view([1])),
            ];
            let mut objective = Tensor::zeros([], (Kind::Float, Device::Cpu));
            for (output, ours) in &outputs {
                assert_close(&what(output), ours, &golden[&format!("out.{output}")], OUTPUT_TOLERANCE);
                if let Some(cotangent) = golden.get(&format!("cotangent.{output}")) {
                    objective = &objective + (ours * cotangent).sum(Kind::Float);
                }
            }
            vs.trainable_variables().iter_mut().for_each(|v| v.zero_grad());
            objective.backward();

            let gradients = golden.iter().filter(|(key, _)| key.starts_with("grad"));
            let largest = gradients.map(|(_, g)| g.norm().double_value(&[])).fold(0., f64::max);
            let mut compared = 0;
            let variables = vs.variables();
            for (key, expected) in golden.iter().filter(|(key, _)| key.starts_with("grad")) {
                let (_, parameter) = key.split_once('.').expect("grad.NAME or grad_input.images");
                let gradient = match parameter {
                    "images" => images.grad(),
                    _ => variables.get(parameter).unwrap_or_else(|| panic!("{key}")).grad(),
                };
                assert!(gradient.defined(), "{}: no gradient", what(parameter));
                if parameter.ends_with(ZERO_GRADIENT) {
                    let error = largest_error(&gradient, expected) / largest;
                    assert!(error <= ZERO_TOLERANCE, "{}: {error:.2e} of the largest", what(parameter));
                } else if expected.norm().double_value(&[]) == 0. {
                    assert_eq!(gradient.norm().double_value(&[]), 0., "{}", what(parameter));
                } else {
                    assert_close(&what(parameter), &gradient, expected, GRADIENT_TOLERANCE);
                }
                compared += 1;
            }
            let trainable = vs.trainable_variables().len();
            assert_eq!(compared, trainable + 1, "{}: gradients compared", what(""));
        }
    }
}

/// Returns the tensors of a file in the golden folder; `None` without a golden folder.
fn golden_file(name: &str) -> Option<BTreeMap<String, Tensor>> {
    Some(read(&golden()?, name).tensors)
}

#[test]
fn the_frustum_loss_matches() {
    let Some(golden) = golden_file("frustum_loss") else { return };
    // The file doesn't contain the size of the images, but the principal points determine it.
    let size = (golden["intrinsic"].double_value(&[0, 0, 0, 2]) * 2.).round() as i64;
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
    let Some(golden) = golden_file("sh_softcap") else { return };
    let sh = golden["sh"].copy().set_requires_grad(true);
    let loss = sh_soft_cap(&sh);
    assert!(relative_error(&loss.view([1]), &golden["reg"]) < 1e-5);
    loss.backward();
    assert!(relative_error(&sh.grad(), &golden["grad"]) < 1e-4);
}

#[test]
fn the_normalization_of_one_and_of_many_cameras_matches() {
    let Some(golden) = golden_file("scene_normalization") else { return };
    let tensor = |poses: &[DMat4]| {
        let rows: Vec<f64> = poses.iter().flat_map(pose_to_rows).collect();
        Tensor::from_slice(&rows).view([-1, 4, 4])
    };
    let values = Vec::<f64>::try_from(golden["c2w"].to_kind(Kind::Double).flatten(0, -1)).expect("numbers");
    let poses: Vec<DMat4> =
        values.chunks_exact(16).map(|rows| DMat4::from_cols_slice(rows).transpose()).collect();
    let many = normalize(&poses).expect("cameras");
    assert!(largest_error(&tensor(&many.c2w), &golden["norm_c2w"]) < 1e-6);
    let w2c: Vec<DMat4> = many.c2w.iter().map(DMat4::inverse).collect();
    assert!(largest_error(&tensor(&w2c), &golden["norm_w2c"]) < 1e-6);
    let similarity = many.world_from_normalized;
    assert!((similarity.scale / golden["scene_scale"].double_value(&[0]) - 1.).abs() < 1e-6);
    for (pose, before) in many.c2w.iter().zip(&poses) {
        let center =
            similarity.scale * (similarity.rotation * pose.w_axis.truncate()) + similarity.translation;
        assert!(center.distance(before.w_axis.truncate()) < 1e-9, "the similarity leads back");
    }
    let one = normalize(&poses[..1]).expect("a camera");
    assert!(largest_error(&tensor(&one.c2w), &golden["single_norm_c2w"]) < 1e-6);
    assert_eq!(one.world_from_normalized.scale, golden["single_scene_scale"].double_value(&[0]));
}
