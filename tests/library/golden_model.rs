//! The model matches tensors that an independent implementation computed: outputs within 1e-5 and gradients within 1e-4
//! relative L2, for every case in the golden folder.

use crate::common::{golden, largest_error, relative_error, rerun_test};
use globalsplat::io::{Weights, read_weights};
use globalsplat::loss::decoder_regularization;
use globalsplat::model::{GlobalSplat, ModelConfig, ModelInput, Stage};
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

#[test]
fn missing_golden_tensors_are_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let (empty, absent) = (folder.path(), folder.path().join("absent"));
    for name in
        ["golden_model::the_encoder_matches", "golden_model::every_stage_matches_in_values_and_gradients"]
    {
        let run = |golden: &Path, strict: &str| {
            rerun_test(name, &[("GLOBALSPLAT_GOLDEN", golden), ("GLOBALSPLAT_NO_SKIPS", Path::new(strict))])
        };
        assert_eq!(run(&absent, ""), (true, "golden tensors\n".into()));
        assert_eq!(run(&absent, "1"), (false, String::new()));
        assert_eq!(run(empty, ""), (false, String::new()));
    }
}
