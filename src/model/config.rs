//! The configuration of the model's architecture.

use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// Number of streams of scene tokens.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Streams {
    /// Separate geometry and appearance streams, joined by a mixer after every round: the full model.
    Dual,
    /// One stream without a mixer: an ablation.
    Single,
}

/// Architecture parameters of spec 3 to 5. The default is the main 16K model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// Edge of a patch in pixels, p.
    pub patch_size: i64,
    /// Number of scene tokens, M.
    pub latents: i64,
    /// Width of a scene token, d.
    pub width: i64,
    /// Width of the RGB half of an image token.
    pub rgb_width: i64,
    /// Width of the ray half of an image token.
    pub ray_width: i64,
    /// Number of encoder rounds.
    pub rounds: i64,
    /// Number of self-attention blocks in each stream and round.
    pub self_attention_blocks: i64,
    /// Number of attention heads.
    pub heads: i64,
    /// Number of candidate Gaussians per scene token, K: a power of two.
    pub candidates: i64,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: i64,
    /// Number of streams: dual, or the single-stream ablation.
    pub streams: Streams,
    /// Adds the camera code to ray tokens if `true`; `false` is the "Plücker only" ablation.
    pub camera_code: bool,
}

impl Default for ModelConfig {
    fn default() -> Self {
        ModelConfig {
            patch_size: 8,
            latents: 2048,
            width: 512,
            rgb_width: 512,
            ray_width: 256,
            rounds: 4,
            self_attention_blocks: 2,
            heads: 8,
            candidates: 16,
            sh_degree: 3,
            streams: Streams::Dual,
            camera_code: true,
        }
    }
}

impl ModelConfig {
    /// Returns the number of spherical harmonics per colour channel.
    pub fn sh_bases(&self) -> i64 {
        (self.sh_degree + 1).pow(2)
    }

    /// Returns the width of an image token.
    pub fn token_width(&self) -> i64 {
        self.ray_width + self.rgb_width
    }

    /// Returns the last stage that the number of candidates allows: log2 K.
    pub fn max_stage(&self) -> u32 {
        self.candidates.ilog2()
    }

    /// Checks that the fields are in range and fit together.
    ///
    /// # Errors
    /// Names the first field that is invalid.
    pub fn check(&self) -> Result<()> {
        // The upper bounds are far beyond any model; they keep products of the fields from overflowing.
        let fields = [
            ("patch_size", self.patch_size, 1..=1 << 10),
            ("latents", self.latents, 1..=1 << 20),
            ("width", self.width, 1..=1 << 16),
            ("rgb_width", self.rgb_width, 1..=1 << 16),
            ("ray_width", self.ray_width, 1..=1 << 16),
            ("rounds", self.rounds, 0..=1 << 10),
            ("self_attention_blocks", self.self_attention_blocks, 0..=1 << 10),
            ("heads", self.heads, 1..=1 << 16),
            ("candidates", self.candidates, 1..=1 << 10),
            ("sh_degree", self.sh_degree, 0..=3),
        ];
        for (name, value, range) in fields {
            if !range.contains(&value) {
                let (least, most) = (range.start(), range.end());
                return Err(Error::setting(format!("model.{name}"), value, format!("{least} to {most}")));
            }
        }
        let expect = |holds: bool, field: &str, value: i64, expected: String| match holds {
            true => Ok(()),
            false => Err(Error::request(format!("model.{field} is {value}, expected {expected}"))),
        };
        expect(
            self.width % self.heads == 0,
            "width",
            self.width,
            format!("a multiple of the {} heads", self.heads),
        )?;
        expect(
            (self.candidates as u64).is_power_of_two(),
            "candidates",
            self.candidates,
            "a power of two".into(),
        )
    }

    /// Returns a lower bound on the number of parameter values of this model: a file with fewer can't hold its weights.
    pub fn least_parameters(&self) -> i64 {
        let attention = self.rounds * (1 + self.self_attention_blocks) * self.width * self.width;
        let patches = 3 * self.patch_size * self.patch_size * self.rgb_width + self.ray_width;
        self.latents * self.width + attention + patches + self.candidates * self.width
    }

    /// Checks that images of this size can be cut into patches.
    ///
    /// # Errors
    /// Names the side that isn't a positive multiple of the patch size.
    pub fn check_image(&self, height: i64, width: i64) -> Result<()> {
        for (name, size) in [("height", height), ("width", width)] {
            if size <= 0 || size % self.patch_size != 0 {
                let p = self.patch_size;
                return Err(Error::request(format!(
                    "the image {name} is {size}, expected a multiple of the patch size {p}"
                )));
            }
        }
        Ok(())
    }
}
