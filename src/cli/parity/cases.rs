//! Parity cases: the code that each case name runs.

use super::{Answer, Request, Tensors};
use crate::config::{OptimizerKind, TrainConfig};
use crate::data::{self, ViewBatch};
use crate::error::{Error, Result};
use crate::io::Weights;
use crate::loss;
use crate::model::{self, EncodedTokens, GlobalSplat, ModelConfig, ModelInput, Precision, RawOutputs, Stage};
use crate::optim::Optimizer;
use crate::reconstruct::fit_colors;
use crate::render::{self, Cameras};
use crate::scene::{self, Gaussians, RadialWarp};
use crate::stereo::depth_search::{ComparedPhoto, Search};
use crate::train;
use glam::{DMat4, DVec3};
use image::RgbImage;
use serde::de::DeserializeOwned;
use std::path::Path;
use tch::{Kind, Tensor, nn};

/// Runs the case that `request` names.
pub(super) fn run(request: &Request) -> Result<Answer> {
    let number = |key| request.number::<f64>(key);
    match request.case.as_str() {
        "tokens" => tokens(request),
        "radial_warp" => radial_warp(request),
        "linear" => linear(request),
        "attention" => attention(request),
        "encoder" => encoder(request),
        "decoder" => decoder(request),
        "quaternion" => outputs([("quaternion", model::quaternion_from_6d(&request.input("rotations")?))]),
        "scene_normalization" => scene_normalization(request),
        "color_fit" => color_fit(request),
        "rasterizer" => rasterizer(request),
        "frustum" => frustum(request),
        "mse" => {
            let [image, ground_truth] = request.image_pair()?;
            loss_of(match request.optional("mask") {
                None => loss::mse(&image, &ground_truth),
                Some(mask) => loss::masked_mse(&image, &ground_truth, &mask),
            })
        }
        "ssim" => {
            let [image, ground_truth] = request.image_pair()?;
            outputs([("ssim", loss::ssim(&image, &ground_truth).view([1]))])
        }
        "photometric" => {
            let [image, ground_truth] = request.image_pair()?;
            let [l1_weight, ssim_weight] = [number("l1_weight")?, number("ssim_weight")?];
            let mask = request.optional("mask");
            loss_of(loss::photometric(&image, &ground_truth, mask.as_ref(), l1_weight, ssim_weight))
        }
        "depth_smoothness" => {
            let ([depth, photo], factor) = (request.inputs(["depth", "photo"])?, number("factor")?);
            let mask = request.optional("mask");
            loss_of(loss::depth_smoothness(&depth, &photo, mask.as_ref(), factor))
        }
        "depth_search" => depth_search(request, Search::PatchCorrelation, "correlation"),
        "semi_global_matching" => depth_search(request, Search::SemiGlobal, "confidence"),
        "decoder_regularization" => {
            let [log_scales, rotations, sh, opacity_logits] =
                request.inputs(["log_scales", "rotations", "sh", "opacity_logits"])?;
            let raw = RawOutputs { log_scales, rotations, sh, opacity_logits };
            loss_of(loss::decoder_regularization(&raw, request.number("opacity")?).total)
        }
        "lpips" => lpips(request),
        "perceptual" => perceptual(request),
        "consistency" => {
            let [alpha_a, alpha_b] = request.inputs(["alpha_a", "alpha_b"])?;
            let [depth_a, depth_b] = request.inputs(["depth_a", "depth_b"])?;
            let factors = (number("alpha_factor")?, number("depth_factor")?);
            let (alpha, depth) = ([&alpha_a, &alpha_b], [&depth_a, &depth_b]);
            loss_of(loss::consistency(alpha, depth, None, factors, &loss::StepFraction::WHOLE))
        }
        "resample" => resample(request),
        "jitter" => jitter(request),
        "adamw" => steps_of(OptimizerKind::AdamW, request),
        "muon" => steps_of(OptimizerKind::Muon, request),
        "model" => whole_model(request),
        other => Err(Error::request(format!("there is no parity case {other}"))),
    }
}

impl Request {
    fn optional(&self, name: &str) -> Option<Tensor> {
        self.inputs.get(name).map(Tensor::shallow_clone)
    }

    fn input(&self, name: &str) -> Result<Tensor> {
        self.optional(name).ok_or_else(|| Error::request(format!("{}: no input {name}", self.case)))
    }

    fn inputs<const N: usize>(&self, names: [&str; N]) -> Result<[Tensor; N]> {
        let found = names.into_iter().map(|name| self.input(name)).collect::<Result<Vec<_>>>()?;
        Ok(found.try_into().expect("a tensor for every name"))
    }

    /// Returns an image and the one that it has to match.
    fn image_pair(&self) -> Result<[Tensor; 2]> {
        self.inputs(["image", "ground_truth"])
    }

    /// Returns the value of `key` in the case's configuration, such as a number or a list.
    fn number<T: DeserializeOwned>(&self, key: &str) -> Result<T> {
        serde_json::from_value(self.config[key].clone())
            .map_err(|e| Error::request(format!("{}: config.{key}: {e}", self.case)))
    }

    fn model_config(&self) -> Result<ModelConfig> {
        // The configuration may hold keys of the model next to keys of the case.
        let known = serde_json::to_value(ModelConfig::default()).expect("numbers and words");
        let known = known.as_object().expect("an object");
        let given = self.config.as_object().cloned().unwrap_or_default();
        let ours = given.into_iter().filter(|(key, _)| known.contains_key(key)).collect();
        serde_json::from_value(serde_json::Value::Object(ours))
            .map_err(|e| Error::request(format!("{}: config: {e}", self.case)))
    }

    fn model_input(&self) -> Result<ModelInput> {
        let [images, c2w, intrinsics] = self.inputs(["images", "c2w", "intrinsics"])?;
        Ok(ModelInput { images, c2w, intrinsics, depths: None })
    }

    fn stage(&self) -> Result<Stage> {
        Ok(Stage { index: self.number("stage")?, mix: self.number("mix")? })
    }

    /// Builds a module and loads the request's parameters into it, whose names must be those of the module.
    fn build<M>(&self, new: impl FnOnce(&nn::Path) -> M) -> Result<(M, Tensors)> {
        let mut vs = nn::VarStore::new(self.device);
        let module = new(&vs.root());
        let mut tensors =
            self.params.iter().map(|(name, t)| (name.clone(), t.shallow_clone())).collect::<Tensors>();
        // The request holds trainable parameters only. Constants keep the values of the module.
        for (name, constant) in vs.variables().into_iter().filter(|(_, t)| !t.requires_grad()) {
            tensors.entry(name).or_insert(constant);
        }
        self.load(&mut vs, tensors)?;
        let params = vs.variables().into_iter().filter(|(_, t)| t.requires_grad()).collect();
        Ok((module, params))
    }

    /// Loads `tensors` into the variables of `vs`, which become float64 if one of these is.
    fn load(&self, vs: &mut nn::VarStore, tensors: Tensors) -> Result<()> {
        if tensors.values().any(|t| t.kind() == Kind::Double) {
            vs.double();
        }
        Weights { tensors, metadata: Default::default() }.load_into(vs, Path::new(&self.case))
    }
}

fn outputs<const N: usize>(outputs: [(&str, Tensor); N]) -> Result<Answer> {
    with_params(outputs, Tensors::new())
}

fn with_params<const N: usize>(outputs: [(&str, Tensor); N], params: Tensors) -> Result<Answer> {
    Ok(Answer { outputs: outputs.into_iter().map(|(name, t)| (name.to_string(), t)).collect(), params })
}

fn loss_of(loss: Tensor) -> Result<Answer> {
    outputs([("loss", loss.view([1]))])
}

fn tokens(request: &Request) -> Result<Answer> {
    let config = request.model_config()?;
    let (module, params) = request.build(|vs| model::Tokenizer::new(vs, &config))?;
    with_params([("tokens", module.forward(&request.model_input()?, None))], params)
}

fn radial_warp(request: &Request) -> Result<Answer> {
    let [c2w, intrinsics, depths] = request.inputs(["c2w", "intrinsics", "depths"])?;
    let [means, scales] = request.inputs(["means", "scales"])?;
    let warp = RadialWarp::new(&c2w, &intrinsics, &depths);
    let others = |width: i64| Tensor::zeros_like(&means).narrow(-1, 0, 1).repeat([1, 1, width]);
    let (quaternions, opacities, sh) = (others(4), others(1).squeeze_dim(-1), others(3).unsqueeze(2));
    let restored = warp.restore(&Gaussians { means, scales, quaternions, opacities, sh, antialiased: false });
    outputs([
        ("rays", warp.rays(&c2w, &intrinsics)),
        ("cameras", warp.cameras(&c2w)),
        ("means", restored.means),
        ("scales", restored.scales),
    ])
}

fn linear(request: &Request) -> Result<Answer> {
    let layer = nn::Linear { ws: request.input("weight")?, bs: request.optional("bias") };
    outputs([("out", precision(request).linear(&layer, &request.input("xs")?).to_kind(Kind::Float))])
}

/// Returns the precision of matrix products: bfloat16 if the case has the key `bf16`, else float32.
fn precision(request: &Request) -> Precision {
    if request.config.get("bf16").is_some() { Precision::Bf16 } else { Precision::F32 }
}

fn attention(request: &Request) -> Result<Answer> {
    let inputs = match request.config.get("thirds") {
        Some(_) => request.input("rows")?.chunk(3, -1),
        None => request.inputs(["q", "k", "v"])?.into(),
    };
    let kind = precision(request).kind();
    let [q, k, v] = [0, 1, 2].map(|n| inputs[n].to_kind(kind));
    let out = model::attention(&q, &k, &v, request.number("heads")?);
    outputs([("out", out.to_kind(inputs[0].kind()))])
}

fn encoder(request: &Request) -> Result<Answer> {
    let config = request.model_config()?;
    let ((scene_tokens, encoder), params) = request.build(|vs| {
        let scene_tokens = model::scene_tokens(vs, &config);
        (scene_tokens, model::Encoder::new(&(vs / "slot_encoder"), &config))
    })?;
    let encoded = encoder.forward(&scene_tokens, &encoder.image_tokens(&request.input("tokens")?));
    with_params([("geometry", encoded.geometry), ("appearance", encoded.appearance)], params)
}

fn decoded(decoded: model::Decoded, params: Tensors) -> Result<Answer> {
    let g = decoded.gaussians;
    let result = [
        ("means", g.means),
        ("scales", g.scales),
        ("rotations_6d", decoded.rotations_6d),
        ("quaternions", g.quaternions),
        ("opacities", g.opacities),
        ("sh", g.sh),
    ];
    with_params(result, params)
}

fn decoder(request: &Request) -> Result<Answer> {
    let config = request.model_config()?;
    let (module, params) = request.build(|vs| model::Decoder::new(vs, &config))?;
    let [geometry, appearance] = request.inputs(["geometry", "appearance"])?;
    decoded(module.forward(&EncodedTokens { geometry, appearance }, request.stage()?), params)
}

fn whole_model(request: &Request) -> Result<Answer> {
    let config = request.model_config()?;
    config.check()?;
    let (module, params) =
        request.build(|vs| GlobalSplat::new(vs, &config).expect("a checked configuration"))?;
    decoded(module.forward(&request.model_input()?, request.stage()?), params)
}

fn scene_normalization(request: &Request) -> Result<Answer> {
    let rows = Vec::<f64>::try_from(request.input("c2w")?.flatten(0, -1)).map_err(Error::external)?;
    let poses: Vec<DMat4> =
        rows.chunks_exact(16).map(|rows| DMat4::from_cols_slice(rows).transpose()).collect();
    let normalization = scene::normalize(&poses)?;
    let rows: Vec<f64> = normalization.c2w.iter().flat_map(scene::pose_to_rows).collect();
    outputs([
        ("c2w", Tensor::from_slice(&rows).view([-1, 4, 4])),
        ("scale", Tensor::from_slice(&[normalization.world_from_normalized.scale])),
    ])
}

/// Runs `search`, whose second result is called `score`.
fn depth_search(request: &Request, search: Search, score: &'static str) -> Result<Answer> {
    let [grays, matrices] = request.inputs(["others", "to_pixels"])?;
    let (grays, weights) =
        (grays.unbind(0), request.optional("other_weights").map(|weights| weights.unbind(0)));
    let compared = |(index, gray)| {
        let matrix = Vec::<f64>::try_from(matrices.get(index as i64).to_kind(Kind::Double).view([-1]))
            .map_err(Error::external)?;
        let column = |i: usize| DVec3::new(matrix[i], matrix[4 + i], matrix[8 + i]);
        let weight = weights.as_ref().map(|weights| &weights[index]);
        Ok(ComparedPhoto { gray, weight, to_pixels: std::array::from_fn(column) })
    };
    let others = grays.iter().enumerate().map(compared).collect::<Result<Vec<_>>>()?;
    let (step, planes) = (request.number("step")?, request.number("planes")?);
    let (inverse_depth, scores) =
        search.run(&request.input("gray")?, request.optional("weight").as_ref(), &others, step, planes);
    let image = |t: Tensor| t.unsqueeze(0).unsqueeze(0);
    outputs([("inverse_depth", image(inverse_depth)), (score, image(scores))])
}

fn gaussians_and_cameras(request: &Request) -> Result<(Gaussians, Cameras)> {
    let [means, scales, quaternions, opacities, sh] =
        request.inputs(["means", "scales", "quaternions", "opacities", "sh"])?;
    let antialiased = request.number("antialiased")?;
    let [w2c, intrinsics] = request.inputs(["w2c", "intrinsics"])?;
    let (width, height) = (request.number("width")?, request.number("height")?);
    let gaussians = Gaussians { means, scales, quaternions, opacities, sh, antialiased };
    Ok((gaussians, Cameras { w2c, intrinsics, width, height }))
}

fn rasterizer(request: &Request) -> Result<Answer> {
    let (gaussians, cameras) = gaussians_and_cameras(request)?;
    let rendered = render::render(&gaussians, &cameras, request.number("eps2d")?)?;
    outputs([("rgb", rendered.rgb), ("alpha", rendered.alpha), ("depth", rendered.depth)])
}

fn color_fit(request: &Request) -> Result<Answer> {
    let (gaussians, cameras) = gaussians_and_cameras(request)?;
    let views = ViewBatch {
        images: request.input("images")?,
        masks: Some(request.input("masks")?),
        depths: None,
        c2w: cameras.w2c.inverse(),
        w2c: cameras.w2c,
        intrinsics: cameras.intrinsics,
    };
    let fitted = fit_colors(&gaussians, &views, request.number("steps")?)?;
    outputs([
        ("contributions", render::image_contributions(&gaussians, &views.cameras())?),
        ("sh", fitted.sh),
    ])
}

fn frustum(request: &Request) -> Result<Answer> {
    let [height, width] = request.number("image_size")?;
    let [w2c, intrinsics, means, far] = request.inputs(["w2c", "intrinsics", "means", "far"])?;
    let images = Tensor::zeros([1, 1, 3, height, width], (Kind::Float, request.device));
    let views = ViewBatch { images, masks: None, depths: None, c2w: w2c.inverse(), w2c, intrinsics };
    loss_of(loss::frustum(&means, &views, &far))
}

fn lpips(request: &Request) -> Result<Answer> {
    let name: String = request.number("network")?;
    let network = loss::PerceptualBackbone::LPIPS.into_iter().find(|network| network.metric() == name);
    let network = network.ok_or_else(|| Error::request(format!("{}: no network {name}", request.case)))?;
    let (lpips, params) = request.build(|vs| loss::PerceptualNetwork::new(vs, network))?;
    let [image, ground_truth] = request.image_pair()?;
    with_params([("distance", lpips.distance(&image, &ground_truth))], params)
}

/// Computes the loss between two renderings of the same targets, as training does. The network's weights are the inputs with a dot in their
/// names.
fn perceptual(request: &Request) -> Result<Answer> {
    let mut vs = nn::VarStore::new(request.device);
    let backbone = match request.number::<String>("kind")?.as_str() {
        "vgg19" => loss::PerceptualBackbone::Vgg19,
        _ => loss::PerceptualBackbone::LpipsAlex,
    };
    let network = loss::PerceptualNetwork::new(&vs.root(), backbone);
    let weights = request.inputs.iter().filter(|(name, _)| name.contains('.'));
    let tensors: Tensors = weights.map(|(name, t)| (name.clone(), t.shallow_clone())).collect();
    request.load(&mut vs, tensors)?;
    vs.freeze();
    let [image, ground_truth] = request.image_pair()?;
    loss_of(network.loss(&image, &ground_truth))
}

fn resample(request: &Request) -> Result<Answer> {
    let image = request.input("image")?;
    let (height, width) = (image.size()[0] as u32, image.size()[1] as u32);
    let bytes = Vec::<u8>::try_from(image.flatten(0, -1)).map_err(Error::external)?;
    let image = RgbImage::from_raw(width, height, bytes).expect("three bytes a pixel");
    let [left, top, region_width, region_height] = request.number("region")?;
    let region = data::Region { left, top, width: region_width, height: region_height };
    let size: scene::ImageSize = request.number("size")?;
    let mut planes = vec![0u8; 3 * size.height as usize * size.width as usize];
    data::Resampler::default().resample(&image, region, size, &mut planes);
    let shape = [3, i64::from(size.height), i64::from(size.width)];
    outputs([("image", Tensor::from_slice(&planes).view(shape).to_kind(Kind::Float))])
}

fn jitter(request: &Request) -> Result<Answer> {
    let image = request.input("image")?;
    let mut planes = Vec::<f32>::try_from(image.flatten(0, -1)).map_err(Error::external)?;
    data::Jitter { adjustments: request.number("adjustments")? }.apply(&mut planes);
    outputs([("image", Tensor::from_slice(&planes).view_as(&image))])
}

fn steps_of(optimizer: OptimizerKind, request: &Request) -> Result<Answer> {
    let mut vs = nn::VarStore::new(request.device);
    for (name, value) in &request.params {
        let mut path = vs.root();
        let mut parts: Vec<&str> = name.split('.').collect();
        let last = parts.pop().expect("a name");
        for part in parts {
            path = path / part;
        }
        let _variable = path.var_copy(last, value);
    }
    vs.unfreeze();
    let config = TrainConfig {
        optimizer,
        learning_rate: request.number("learning_rate")?,
        weight_decay: request.number("weight_decay")?,
        ..Default::default()
    };
    let mut optimizer = Optimizer::new(train::parameter_groups(&vs, &config));
    let variables: Tensors = vs.variables().into_iter().collect();
    let gradients = |name: &str| request.input(&format!("grad.{name}"));
    let count = variables.keys().next().map_or(Ok(0), |name| gradients(name).map(|g| g.size()[0]))?;
    for step in 0..count {
        optimizer.zero_grad();
        let mut objective = Tensor::zeros([], (Kind::Float, request.device));
        for (name, variable) in &variables {
            objective = &objective + (variable * gradients(name)?.get(step)).sum(Kind::Float);
        }
        objective.backward();
        optimizer.step()?;
    }
    let outputs = variables.into_iter().map(|(name, value)| (name, value.detach())).collect();
    Ok(Answer { outputs, params: Tensors::new() })
}
