//! The model's parameters, variants and image sizes.

use globalsplat::config::Config;
use globalsplat::model::{GlobalSplat, ModelConfig, ModelInput, Precision, Stage, Streams};
use globalsplat::reconstruct::{LoadedModel, ModelFile, save_model};
use std::collections::BTreeMap;
use tch::{Device, Kind, Tensor, nn};

fn build(config: &ModelConfig) -> (nn::VarStore, GlobalSplat) {
    let vs = nn::VarStore::new(Device::Cpu);
    let model = GlobalSplat::new(&vs.root(), config).expect("a valid configuration");
    (vs, model)
}

fn small() -> ModelConfig {
    ModelConfig {
        latents: 12,
        width: 32,
        rgb_width: 24,
        ray_width: 16,
        rounds: 2,
        heads: 4,
        ..Default::default()
    }
}

/// Returns `views` images of noise from cameras in a row.
fn input(views: i64, height: i64, width: i64) -> ModelInput {
    let options = (Kind::Float, Device::Cpu);
    let images = Tensor::rand([1, views, 3, height, width], options);
    let c2w = Tensor::eye(4, options).repeat([1, views, 1, 1]);
    c2w.select(3, 3).select(2, 0).copy_(&Tensor::linspace(-0.5, 0.5, views, options).unsqueeze(0));
    let (w, h) = (width as f32, height as f32);
    let intrinsics = Tensor::from_slice(&[w, 0., w / 2., 0., w, h / 2., 0., 0., 1.]).view([3, 3]);
    ModelInput { images, c2w, intrinsics: intrinsics.repeat([1, views, 1, 1]), depths: None }
}

#[test]
fn the_main_model_has_the_published_names_and_shapes() {
    let (vs, _) = build(&ModelConfig::default());
    let trained: usize = vs.trainable_variables().iter().map(Tensor::numel).sum();
    assert_eq!(trained, 84_321_120);
    let Some(golden) = crate::common::golden() else { return };
    let table = golden.join("../spec/state_dict_16k.tsv");
    let Ok(table) = std::fs::read_to_string(&table) else {
        crate::common::skip("the published names", &format!("{} is missing", table.display()));
        return;
    };
    let expected: BTreeMap<String, Vec<i64>> = table
        .lines()
        .map(|line| {
            let (name, shape) = line.split_once('\t').expect("name and shape");
            (name.to_string(), shape.split(',').map(|s| s.parse().expect("a size")).collect())
        })
        .collect();
    let ours: BTreeMap<String, Vec<i64>> =
        vs.variables().into_iter().map(|(name, t)| (name, t.size())).collect();
    assert_eq!(expected.len(), 454);
    assert_eq!(ours, expected);
}

#[test]
fn ablations_lack_what_they_leave_out() {
    let (vs, _) = build(&ModelConfig { streams: Streams::Single, width: 776, ..Default::default() });
    let trained: usize = vs.trainable_variables().iter().map(Tensor::numel).sum();
    assert!((trained as f64 / 90e6 - 1.).abs() <= 0.01, "the paper's single stream has 90 M: {trained}");
    assert!(vs.variables().keys().all(|name| !name.contains("tex") && !name.contains("pair_adapters")));
    let (vs, _) = build(&ModelConfig { camera_code: false, ..small() });
    assert!(vs.variables().keys().all(|name| !name.starts_with("view_pe")));
}

#[test]
fn bf16_is_float32_but_for_its_rounding() {
    for streams in [Streams::Dual, Streams::Single] {
        let (vs, mut model) = build(&ModelConfig { streams, ..small() });
        let mut random = crate::common::Random::new(3);
        // Variables are visited in the order of their names. The map's own order differs between processes, and so would the weights.
        for (name, variable) in &mut vs.variables().into_iter().collect::<BTreeMap<_, _>>() {
            // Large values, so that every layer matters: LayerScale is initialized to a thousandth.
            let is_norm = name.ends_with(".weight") && variable.dim() == 1;
            let value = random.symmetric(&variable.size()) * 0.3 + if is_norm { 1. } else { 0. };
            tch::no_grad(|| variable.copy_(&value));
        }
        let images = random.uniform(&[1, 3, 3, 16, 24]).to_kind(Kind::Float);
        let input = ModelInput { images, ..input(3, 16, 24) };
        let mut run = |precision| {
            model.set_precision(precision);
            let decoded = model.forward(&input, Stage::complete(3));
            let g = decoded.gaussians.map(Tensor::shallow_clone);
            vs.trainable_variables().iter_mut().for_each(|variable| variable.zero_grad());
            (g.means.square().sum(Kind::Float) + g.sh.square().sum(Kind::Float)).backward();
            let gradients = vs.trainable_variables().into_iter().map(|variable| variable.grad());
            let gradient: Vec<Tensor> =
                gradients.filter(Tensor::defined).map(|gradient| gradient.flatten(0, -1)).collect();
            (g, Tensor::cat(&gradient, 0))
        };
        let (exact, exact_gradient) = run(Precision::F32);
        let (rounded, rounded_gradient) = run(Precision::Bf16);
        let pairs = [
            ("means", &rounded.means, &exact.means),
            ("scales", &rounded.scales, &exact.scales),
            ("quaternions", &rounded.quaternions, &exact.quaternions),
            ("opacities", &rounded.opacities, &exact.opacities),
            ("sh", &rounded.sh, &exact.sh),
            ("gradient", &rounded_gradient, &exact_gradient),
        ];
        for (name, rounded, exact) in pairs {
            assert_eq!(rounded.kind(), Kind::Float, "{name}");
            let error = crate::common::relative_error(rounded, exact);
            assert!((1e-5..2e-2).contains(&error), "{streams:?}, {name}: relative error {error:.1e}");
        }
    }
}

#[test]
fn weights_of_a_file_in_bf16_are_kept_in_it() {
    let config = Config { model: ModelConfig { streams: Streams::Dual, ..small() }, ..Default::default() };
    let (vs, _) = build(&config.model);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let stage = config.curriculum.final_stage();
    save_model(&path, &vs, &config, stage, Precision::Bf16).unwrap();
    let load = |precision| ModelFile::open(&path, &[]).unwrap().load(Device::Cpu, precision).unwrap();

    let mut cast = load(Precision::F32);
    cast.model.set_precision(Precision::Bf16);
    let kept = load(Precision::Bf16);
    let bytes = |loaded: &LoadedModel, kind: Kind| -> usize {
        let variables = loaded.vs.variables().into_values().filter(|t| t.kind() == kind);
        variables.map(|t| t.numel() * t.kind().elt_size_in_bytes()).sum()
    };
    assert_eq!(bytes(&cast, Kind::BFloat16), 0);
    assert!(bytes(&kept, Kind::BFloat16) > 0);
    assert_eq!(bytes(&kept, Kind::Float) + 2 * bytes(&kept, Kind::BFloat16), bytes(&cast, Kind::Float));

    let input = input(3, 16, 24);
    let [cast, kept] =
        [&cast, &kept].map(|loaded| tch::no_grad(|| loaded.model.forward(&input, stage).gaussians));
    assert!(cast.means.equal(&kept.means) && cast.scales.equal(&kept.scales) && cast.sh.equal(&kept.sh));
    assert!(cast.quaternions.equal(&kept.quaternions) && cast.opacities.equal(&kept.opacities));
}

#[test]
fn initial_weights_are_as_specified() {
    tch::manual_seed(0);
    let (vs, _) = build(&ModelConfig { rounds: 1, ..Default::default() });
    let variables = vs.variables();
    let std = |name: &str| variables[name].std(false).double_value(&[]);
    let near =
        |value: f64, expected: f64| assert!((value / expected - 1.).abs() < 0.05, "{value} for {expected}");
    near(std("slot_encoder.geo_rounds.0.lat_q.weight"), 0.02);
    near(std("slot_encoder.mem_regs"), 0.02);
    near(std("scene_tokens"), 0.02);
    near(std("gaussian_decoder.geo_pos_readout.weight"), 1e-2);
    near(std("gaussian_decoder.sh_readout.weight"), 1e-3);
    near(std("rgb_patch_embeds.1.weight"), 1. / (3f64 * 192.).sqrt()); // uniform ±1/√192
    near(variables["slot_encoder.geo_rounds.0.attn_ls.gamma"].mean(Kind::Float).double_value(&[]), 1e-3);
    near(variables["slot_encoder.geo_rounds.0.tower.1.ls2.gamma"].mean(Kind::Float).double_value(&[]), 1e-2);
    for name in ["slot_encoder.geo_rounds.0.lat_q.bias", "gaussian_decoder.gate_readout.bias"] {
        assert_eq!(variables[name].abs().max().double_value(&[]), 0.);
    }
    // M ≤ d: orthogonal rows of length 0.02.
    let (vs, _) = build(&small());
    let tokens = &vs.variables()["scene_tokens"];
    let gram = tokens.matmul(&tokens.tr()) / (0.02 * 0.02);
    assert!(crate::common::largest_error(&gram, &Tensor::eye(12, (Kind::Float, Device::Cpu))) < 1e-5);
}

#[test]
fn configurations_out_of_range_are_refused() {
    let refused = [
        (ModelConfig { width: 30, heads: 4, ..small() }, "model.width is 30"),
        (ModelConfig { candidates: 6, ..small() }, "model.candidates is 6"),
        (ModelConfig { sh_degree: 4, ..small() }, "model.sh_degree is 4"),
        (ModelConfig { patch_size: 0, ..small() }, "model.patch_size is 0"),
    ];
    for (config, message) in refused {
        let vs = nn::VarStore::new(Device::Cpu);
        let error = GlobalSplat::new(&vs.root(), &config).expect_err("a refusal").to_string();
        assert!(error.starts_with(message), "{error}");
    }
    assert!(small().check_image(20, 16).unwrap_err().to_string().contains("height is 20"));
}
