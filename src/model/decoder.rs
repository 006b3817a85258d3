//! The decoder: linear heads, the merging of candidates, and the activations that turn both into Gaussians (spec 5).

use super::config::{ModelConfig, OPACITY, PARAMETERS};
use super::encoder::EncodedTokens;
use super::layers::linear;
use super::precision::Precision;
use crate::scene::{Gaussians, RadialWarp, sigmoid};
use serde::{Deserialize, Serialize};
use std::f64::consts::LN_2;
use tch::{Kind, Tensor, nn};

/// Standard deviation of the initial weights of the geometry heads.
const GEOMETRY_STD: f64 = 1e-2;
/// Standard deviation of the initial weights of the SH head.
const SH_STD: f64 = 1e-3;

/// Offset added to every position: initially the scene lies in front of the mean camera.
const MEAN_OFFSET: [f32; 3] = [0., 0., 1.5];
const LOG_SCALE_OFFSET: f64 = -2.;
const OPACITY_OFFSET: f64 = -5.;
const MAX_OPACITY: f64 = 0.99;
/// Minimum and maximum of the opacity logits.
const LOGIT_RANGE: [f64; 2] = [-13., 6.];
const MIN_SCALE: f64 = 1e-4;
/// Scale above which scales are penalized (the clamp lies further out).
pub(crate) const MAX_SCALE: f64 = 0.05;

/// Position in the coarse-to-fine curriculum.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Stage {
    /// Stage index s: every scene token is decoded into 2^s Gaussians.
    pub index: u32,
    /// Progress λ in [0, 1] of the transition from stage s − 1; 1 at stage 0.
    pub mix: f64,
}

impl Stage {
    /// Returns stage `index` with its transition completed.
    pub fn complete(index: u32) -> Self {
        Stage { index, mix: 1. }
    }
}

/// Outputs of the heads before any clamp, for the regularizers of `loss`.
#[derive(Debug)]
pub struct RawOutputs {
    /// Log-scales with their offset, [B, M, K, 3].
    pub log_scales: Tensor,
    /// Rotation residuals, [B, M, K, 6].
    pub rotations: Tensor,
    /// Spherical harmonics, [B, M, K, bases · 3].
    pub sh: Tensor,
    /// Logits of the opacities after merging, [B, N].
    pub opacity_logits: Tensor,
}

/// Decoded Gaussians, and the other outputs that the losses need.
#[derive(Debug)]
pub struct Decoded {
    /// The decoded Gaussians, N = M · 2^s per scene.
    pub gaussians: Gaussians,
    /// Pairs of normalized vectors from which the quaternions are computed, [B, N, 6].
    pub rotations_6d: Tensor,
    /// Outputs of the heads before clamps.
    pub raw: RawOutputs,
}

impl Decoded {
    /// Moves the Gaussians of the warped world back to the normalized one. Without a `warp` they are there already.
    pub(super) fn unwarp(self, warp: Option<&RadialWarp>) -> Self {
        match warp {
            Some(warp) => Decoded { gaussians: warp.restore(&self.gaussians), ..self },
            None => self,
        }
    }

    /// Applies `f` to every tensor.
    pub(crate) fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        Decoded {
            gaussians: self.gaussians.map(&f),
            rotations_6d: f(&self.rotations_6d),
            raw: RawOutputs {
                log_scales: f(&self.raw.log_scales),
                rotations: f(&self.raw.rotations),
                sh: f(&self.raw.sh),
                opacity_logits: f(&self.raw.opacity_logits),
            },
        }
    }

    /// Returns every tensor.
    pub(crate) fn tensors(&self) -> [&Tensor; 10] {
        let Decoded { gaussians: g, rotations_6d, raw } = self;
        [
            &g.means,
            &g.scales,
            &g.quaternions,
            &g.opacities,
            &g.sh,
            rotations_6d,
            &raw.log_scales,
            &raw.rotations,
            &raw.sh,
            &raw.opacity_logits,
        ]
    }
}

/// Decoder from scene tokens to Gaussians.
#[derive(Debug)]
pub struct Decoder {
    mean_offset: Tensor,
    positions: nn::Linear,
    parameters: nn::Linear,
    gate: nn::Linear,
    sh: nn::Linear,
    candidates: i64,
    sh_bases: i64,
    /// Precision of the appearance head, the largest product. The other heads determine positions and shapes and stay in float32.
    pub(super) precision: Precision,
}

impl Decoder {
    /// Builds the decoder under `vs`, the decoder's own path.
    pub fn new(vs: &nn::Path, config: &ModelConfig) -> Self {
        let (d, k) = (config.width, config.candidates);
        let mut mean_offset = vs.zeros_no_train("patch_center_bias", &[1, 1, 3]);
        tch::no_grad(|| mean_offset.copy_(&Tensor::from_slice(&MEAN_OFFSET).view([1, 1, 3])));
        Decoder {
            mean_offset,
            positions: linear(vs / "geo_pos_readout", d, 3 * k, GEOMETRY_STD),
            parameters: linear(vs / "geo_param_readout", d, PARAMETERS * k, GEOMETRY_STD),
            gate: linear(vs / "gate_readout", d, k, GEOMETRY_STD),
            sh: linear(vs / "sh_readout", d, 3 * config.sh_bases() * k, SH_STD),
            candidates: k,
            sh_bases: config.sh_bases(),
            precision: Precision::default(),
        }
    }

    /// Returns the layers that compute in the configurable precision.
    pub(super) fn linear_layers(&self) -> impl Iterator<Item = &nn::Linear> {
        std::iter::once(&self.sh)
    }

    /// Applies only the linear heads. Returns their outputs for each candidate, [B, M, K, ..], and the gate, [B, M, K]. Log-scales have their
    /// offset, opacity logits don't.
    fn heads(&self, encoded: &EncodedTokens) -> (Candidates, Tensor) {
        let (b, m, _) = encoded.geometry.size3().expect("[B, M, d]");
        let k = self.candidates;
        let of_geometry = |head| Precision::F32.linear(head, &encoded.geometry);
        let parameters = of_geometry(&self.parameters).view([b, m, k, PARAMETERS]);
        let sh = self.precision.linear(&self.sh, &encoded.appearance).to_kind(encoded.appearance.kind());
        let outputs = Candidates {
            positions: of_geometry(&self.positions).view([b, m, k, 3]),
            log_scales: parameters.narrow(-1, 0, 3) + LOG_SCALE_OFFSET,
            rotations: parameters.narrow(-1, 3, 6),
            opacity_logits: parameters.narrow(-1, OPACITY, 1),
            sh: sh.view([b, m, k, self.sh_bases * 3]),
        };
        (outputs, of_geometry(&self.gate))
    }

    /// Applies the heads and builds the Gaussians of `stage`.
    pub fn forward(&self, encoded: &EncodedTokens, stage: Stage) -> Decoded {
        let (outputs, gate) = self.heads(encoded);
        let Candidates { positions, log_scales, rotations, opacity_logits, sh } = outputs;
        // A transition doubles the number of Gaussians, so it starts with half the opacity.
        let opacity_logits = opacity_logits + (OPACITY_OFFSET - (1. - stage.mix) * LN_2);
        let candidates = Candidates {
            positions,
            log_scales: log_scales.clamp(MIN_SCALE.ln() - 1., MAX_SCALE.ln() + 2.),
            rotations: rotations.shallow_clone(),
            opacity_logits: opacity_logits.clamp(LOGIT_RANGE[0], LOGIT_RANGE[1]),
            sh: sh.shallow_clone(),
        };
        let shown = candidates.at_stage(&gate, stage); // [B, M, G, ..]

        let (b, n) = (gate.size()[0], gate.size()[1] << stage.index);
        let rotations_6d = self.activate_rotations(&shown.rotations.view([b, n, 6]));
        let logits = shown.opacity_logits.view([b, n]);
        let gaussians = Gaussians {
            means: shown.positions.view([b, n, 3]) + &self.mean_offset,
            scales: shown.log_scales.view([b, n, 3]).exp(),
            quaternions: quaternion_from_6d(&rotations_6d),
            opacities: sigmoid(&logits).clamp(0., MAX_OPACITY),
            sh: shown.sh.view([b, n, self.sh_bases, 3]),
            antialiased: false,
        };
        let raw = RawOutputs { log_scales, rotations, sh, opacity_logits: logits };
        Decoded { gaussians, rotations_6d, raw }
    }

    /// Converts rotation residuals to pairs of unit vectors, [B, N, 6].
    fn activate_rotations(&self, residuals: &Tensor) -> Tensor {
        let identity = Tensor::eye_m(2, 3, (residuals.kind(), residuals.device()));
        normalize(&(residuals.unflatten(-1, [2, 3]) + identity)).flatten(-2, -1)
    }
}

/// Upper bound of log u = log(1 − α), so that an opacity of 0 still has a finite logit.
const MAX_LOG_U: f64 = -1e-12;

/// Five quantities before activation, of candidates, [B, M, K, ..], or of merged Gaussians, [B, M, G, ..].
#[derive(Debug)]
struct Candidates {
    positions: Tensor,      // [.., 3]
    log_scales: Tensor,     // [.., 3]
    rotations: Tensor,      // [.., 6]
    opacity_logits: Tensor, // [.., 1]
    sh: Tensor,             // [.., bases · 3]
}

impl Candidates {
    /// Returns the Gaussians of `stage`, blended with those of the previous stage during a transition. `gate` is [B, M, K].
    pub fn at_stage(&self, gate: &Tensor, stage: Stage) -> Candidates {
        let merged = self.merge(gate, 1 << stage.index);
        if stage.index == 0 || stage.mix >= 1. {
            return merged;
        }
        let expanded = self.merge(gate, 1 << (stage.index - 1)).expand();
        let mix = |old: &Tensor, new: &Tensor| old * (1. - stage.mix) + new * stage.mix;
        Candidates {
            positions: mix(&expanded.positions, &merged.positions),
            log_scales: mix(&expanded.log_scales, &merged.log_scales),
            rotations: mix(&expanded.rotations, &merged.rotations),
            opacity_logits: mix(&expanded.opacity_logits, &merged.opacity_logits),
            sh: mix(&expanded.sh, &merged.sh),
        }
    }

    /// Merges every b = K / `groups` consecutive candidates with weights w = softmax(gate). Positions, rotations and SH are weighted means;
    /// scales grow by b^(1/3), as b volumes are merged into one; log u = Σ w log(1 − α).
    fn merge(&self, gate: &Tensor, groups: i64) -> Candidates {
        let (b, m, k) = gate.size3().expect("[B, M, K]");
        let members = k / groups;
        // Reduce along the last dimension: along others, the bits of the result depend on the number of threads.
        let weights = gate.view([b, m, groups, members]).softmax(-1, None::<Kind>).unsqueeze(-1);
        let weighted = |t: &Tensor| {
            let grouped = t.view([b, m, groups, members, -1]);
            (&weights * grouped).sum_dim_intlist([3i64].as_slice(), false, None::<Kind>)
        };
        Candidates {
            positions: weighted(&self.positions),
            log_scales: weighted(&self.log_scales) + (members as f64).ln() / 3.,
            rotations: weighted(&self.rotations),
            opacity_logits: logit_from_log_u(&weighted(&log_u_from_logit(&self.opacity_logits))),
            sh: weighted(&self.sh),
        }
    }

    /// Repeats every Gaussian twice, consecutively, each copy with half of the volume and half of the optical depth log u.
    fn expand(&self) -> Candidates {
        let twice = |t: &Tensor| t.repeat_interleave_self_int(2, 2, None);
        Candidates {
            positions: twice(&self.positions),
            log_scales: twice(&(&self.log_scales - LN_2 / 3.)),
            rotations: twice(&self.rotations),
            opacity_logits: twice(&logit_from_log_u(&(log_u_from_logit(&self.opacity_logits) * 0.5))),
            sh: twice(&self.sh),
        }
    }
}

/// Computes log(1 − sigmoid(x)) = log sigmoid(−x).
fn log_u_from_logit(logit: &Tensor) -> Tensor {
    (-logit).log_sigmoid()
}

/// Computes logit(1 − u) = log(1 − e^{log u}) − log u.
fn logit_from_log_u(log_u: &Tensor) -> Tensor {
    let log_u = log_u.clamp_max(MAX_LOG_U);
    (-log_u.expm1()).log() - log_u
}

/// Minimum norm that vectors are divided by.
const EPS: f64 = 1e-8;

/// Divides each vector along the last dimension by its length, clamped to at least 1e-8.
pub(super) fn normalize(xs: &Tensor) -> Tensor {
    xs / xs.norm_scalaropt_dim(2, [-1i64], true).clamp_min(EPS)
}

/// Computes rotation matrices, [.., 3, 3], from `rotations` [.., 6]. b1 = normalize(first), b2 = normalize(second − (b1·second) b1), b3 =
/// b1 × b2 are the ROWS of the result.
pub fn rotation_matrix_from_6d(rotations: &Tensor) -> Tensor {
    let (first, second) = (rotations.narrow(-1, 0, 3), rotations.narrow(-1, 3, 3));
    let b1 = normalize(&first);
    let along = (&b1 * &second).sum_dim_intlist([-1i64].as_slice(), true, None::<Kind>);
    let b2 = normalize(&(second - along * &b1));
    let b3 = b1.linalg_cross(&b2, -1);
    Tensor::stack(&[b1, b2, b3], -2)
}

/// Computes the quaternion (w, x, y, z), w ≥ 0, of [`rotation_matrix_from_6d`]; the result is [.., 4].
///
/// 4 q qᵀ is linear in the matrix, and each of its rows is a multiple of q. The row with the largest diagonal entry (at least 1) is far
/// from zero, so normalizing it loses no precision.
pub fn quaternion_from_6d(rotations: &Tensor) -> Tensor {
    let matrix = rotation_matrix_from_6d(rotations).flatten(-2, -1).unbind(-1);
    let [m00, m01, m02, m10, m11, m12, m20, m21, m22] =
        <[Tensor; 9]>::try_from(matrix).expect("nine entries");
    let rows = [
        [&m00 + &m11 + &m22 + 1., &m21 - &m12, &m02 - &m20, &m10 - &m01],
        [&m21 - &m12, &m00 - &m11 - &m22 + 1., &m10 + &m01, &m02 + &m20],
        [&m02 - &m20, &m10 + &m01, &m11 - &m00 - &m22 + 1., &m12 + &m21],
        [&m10 - &m01, &m20 + &m02, &m21 + &m12, &m22 - &m00 - &m11 + 1.],
    ];
    let rows = rows.map(|row| Tensor::stack(&row, -1));
    let rows = Tensor::stack(&rows, -2); // [.., 4, 4]
    let largest = rows.diagonal(0, -2, -1).argmax(-1, true).unsqueeze(-1); // [.., 1, 1]
    let mut index = largest.size();
    *index.last_mut().expect("a last dimension") = 4;
    let row = rows.gather(-2, &largest.expand(&index, false), false).squeeze_dim(-2);
    let sign = row.narrow(-1, 0, 1).ge(0.).to_kind(row.kind()) * 2. - 1.;
    normalize(&row) * sign
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Device;

    #[test]
    fn bf16_is_for_appearance_alone() {
        let vs = nn::VarStore::new(Device::Cpu);
        let config = ModelConfig { width: 32, latents: 8, candidates: 4, ..Default::default() };
        let mut decoder = Decoder::new(&vs.root(), &config);
        let tokens = || Tensor::linspace(-1., 1., 8 * 32, (Kind::Float, Device::Cpu)).sin().view([1, 8, 32]);
        let encoded = EncodedTokens { geometry: tokens(), appearance: tokens() };
        let (exact, exact_gate) = decoder.heads(&encoded);
        decoder.precision = Precision::Bf16;
        let (rounded, gate) = decoder.heads(&encoded);
        assert!(rounded.positions.equal(&exact.positions) && gate.equal(&exact_gate));
        assert!(rounded.rotations.equal(&exact.rotations) && rounded.log_scales.equal(&exact.log_scales));
        assert!(rounded.opacity_logits.equal(&exact.opacity_logits));
        let error = ((&rounded.sh - &exact.sh).norm() / exact.sh.norm()).double_value(&[]);
        assert!(rounded.sh.kind() == Kind::Float && (1e-4..1e-2).contains(&error), "{error:.1e}");
    }
}
