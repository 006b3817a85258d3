//! From K candidates per scene token to the G = 2^s Gaussians of a stage, and from one stage to the next
//! (spec 5.3 and 5.4).

use serde::{Deserialize, Serialize};
use std::f64::consts::LN_2;
use tch::{Kind, Tensor};

/// log u = log(1 − α) is kept at or below it, so that an opacity of 0 still has a logit.
const MAX_LOG_U: f64 = -1e-12;

/// Where the coarse-to-fine curriculum stands.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Stage {
    /// s: every scene token shows 2^s Gaussians.
    pub index: u32,
    /// λ in [0, 1]: how far the transition from stage s − 1 has come. 1 at stage 0.
    pub mix: f64,
}

impl Stage {
    /// Stage `index` with its transition done.
    pub fn complete(index: u32) -> Self {
        Stage { index, mix: 1. }
    }
}

/// Candidates, [B, M, K, ..], or merged Gaussians, [B, M, G, ..]: the same five quantities before activation.
#[derive(Debug)]
pub(crate) struct Candidates {
    pub positions: Tensor,      // [.., 3]
    pub log_scales: Tensor,     // [.., 3]
    pub rotations: Tensor,      // [.., 6]
    pub opacity_logits: Tensor, // [.., 1]
    pub sh: Tensor,             // [.., bases · 3]
}

impl Candidates {
    /// Gaussians of `stage`, with the transition from the one before. `gate` [B, M, K].
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

    /// Merges every b = K / `groups` consecutive candidates by weights w = softmax(gate): means of positions, rotations
    /// and SH; scales grow by b^(1/3), as b volumes are put into one; log u = Σ w log(1 − α).
    fn merge(&self, gate: &Tensor, groups: i64) -> Candidates {
        let (b, m, k) = gate.size3().expect("[B, M, K]");
        let members = k / groups;
        // Along the last dimension: along others, bits depend on the number of threads.
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

    /// Every Gaussian twice, side by side, each with half of the volume and half of the optical depth log u.
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

/// log(1 − sigmoid(x)) = log sigmoid(−x).
fn log_u_from_logit(logit: &Tensor) -> Tensor {
    (-logit).log_sigmoid()
}

/// logit(1 − u) = log(1 − e^{log u}) − log u.
fn logit_from_log_u(log_u: &Tensor) -> Tensor {
    let log_u = log_u.clamp_max(MAX_LOG_U);
    (-log_u.expm1()).log() - log_u
}
