//! Inference of the model configuration from parameter shapes: published weights come without a configuration.

use super::config::{ModelConfig, Streams};
use crate::error::{Error, Result};
use std::collections::BTreeMap;
use std::path::Path;

/// First components, up to the first dot, of all parameter names.
pub const MODULES: [&str; 6] =
    ["scene_tokens", "rgb_patch_embeds", "ray_patch_embeds", "view_pe", "slot_encoder", "gaussian_decoder"];

impl ModelConfig {
    /// Returns the configuration of the model whose parameters, by their published names, have these shapes. The number of heads can't be
    /// inferred from shapes and keeps its default.
    ///
    /// # Errors
    /// Returns an error if a required parameter is missing or has a shape that no model has. `origin` is the file named in the error.
    pub fn from_shapes(shapes: &BTreeMap<String, Vec<i64>>, origin: &Path) -> Result<Self> {
        let refuse = |name: &str, found: String, expected: &str| {
            Error::input(origin, format!("tensor {name}"), found, expected)
        };
        let matrix = |name: &str| match shapes.get(name).map(Vec::as_slice) {
            Some(&[rows, columns]) if rows > 0 && columns > 0 => Ok([rows, columns]),
            Some(other) => Err(refuse(name, format!("{other:?}"), "a matrix")),
            None => Err(refuse(name, "missing".into(), "one of a GlobalSplat model's weights")),
        };
        let count = |name: &dyn Fn(usize) -> String| {
            (0..).take_while(|&i| shapes.contains_key(&name(i))).count() as i64
        };
        let [latents, width] = matrix("scene_tokens")?;
        let (rgb, sh) = ("rgb_patch_embeds.1.weight", "gaussian_decoder.sh_readout.weight");
        let [rgb_width, inputs] = matrix(rgb)?;
        let [ray_width, _] = matrix("ray_patch_embeds.1.weight")?;
        let patch_size = (inputs / 3).isqrt();
        if 3 * patch_size * patch_size != inputs {
            return Err(refuse(
                rgb,
                format!("{:?}", [rgb_width, inputs]),
                "3 p² columns, of patches of p×p pixels",
            ));
        }
        let [candidates, _] = matrix("gaussian_decoder.gate_readout.weight")?;
        let [numbers, columns] = matrix(sh)?;
        let bases = numbers / 3 / candidates;
        let sh_degree = bases.isqrt() - 1;
        if 3 * candidates * (sh_degree + 1) * (sh_degree + 1) != numbers {
            let expected = format!("3 (l + 1)² rows of each of {candidates} candidates, of SH degree l");
            return Err(refuse(sh, format!("{:?}", [numbers, columns]), &expected));
        }
        let config = ModelConfig {
            patch_size,
            latents,
            width,
            rgb_width,
            ray_width,
            rounds: count(&|i| format!("slot_encoder.geo_rounds.{i}.lat_q.weight")),
            self_attention_blocks: count(&|i| format!("slot_encoder.geo_rounds.0.tower.{i}.norm1.weight")),
            candidates,
            sh_degree,
            streams: match shapes.contains_key("slot_encoder.slot_to_tex.1.weight") {
                true => Streams::Dual,
                false => Streams::Single,
            },
            camera_code: shapes.contains_key("view_pe.proj.weight"),
            ..Default::default()
        };
        Ok(config)
    }
}
