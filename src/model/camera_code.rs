//! The camera code: one vector per view that distinguishes cameras beyond their Plücker rays (spec 3.3).

use super::layers::{default_linear, gelu};
use std::f64::consts::PI;
use tch::{Tensor, nn, nn::Module};

/// Width of the intrinsics features.
const INTRINSICS_WIDTH: i64 = 64;
/// Frequencies of the camera centre's encoding, in units of π.
const FREQUENCIES: [f64; 4] = [1., 2., 4., 8.];
/// Width of the encoded camera centre: the centre, its sines and its cosines.
const CENTRE_WIDTH: i64 = 3 + 2 * 3 * FREQUENCIES.len() as i64;

/// Encoder of intrinsics by an MLP and of the camera centre by sines and cosines, joined by one linear layer.
#[derive(Debug)]
pub(crate) struct CameraCode {
    intrinsics_in: nn::Linear,
    intrinsics_out: nn::Linear,
    project: nn::Linear,
}

impl CameraCode {
    pub fn new(vs: &nn::Path, width: i64) -> Self {
        let mlp = vs / "k_mlp";
        CameraCode {
            intrinsics_in: default_linear(&mlp / "0", 4, INTRINSICS_WIDTH, true),
            intrinsics_out: default_linear(&mlp / "2", INTRINSICS_WIDTH, INTRINSICS_WIDTH, true),
            project: default_linear(vs / "proj", INTRINSICS_WIDTH + CENTRE_WIDTH, width, true),
        }
    }

    /// Computes the camera code, [B, V, width]. `c2w` is [B, V, 4, 4], `intrinsics` [B, V, 3, 3] in pixels of a `height` × `width` image.
    pub fn forward(&self, c2w: &Tensor, intrinsics: &Tensor, height: i64, width: i64) -> Tensor {
        let entry = |row: i64, column: i64| intrinsics.select(-2, row).select(-1, column);
        let (w, h) = (width as f64, height as f64);
        let features = [(entry(0, 0) / w).log(), (entry(1, 1) / h).log(), entry(0, 2) / w, entry(1, 2) / h];
        let features = Tensor::stack(&features, -1); // [B, V, 4]
        let intrinsics = gelu(self.intrinsics_in.forward(&features));
        let intrinsics = gelu(self.intrinsics_out.forward(&intrinsics));

        let centre = c2w.narrow(-2, 0, 3).select(-1, 3); // [B, V, 3]
        let phases: Vec<Tensor> = FREQUENCIES.iter().map(|f| &centre * (f * PI)).collect();
        let phases = Tensor::cat(&phases, -1); // frequency-major, xyz inside
        let code = Tensor::cat(&[intrinsics, centre, phases.sin(), phases.cos()], -1); // [B, V, 64 + 27]
        self.project.forward(&code)
    }
}
