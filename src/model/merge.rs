//! Merging of K candidates per scene token into the G = 2^s Gaussians of a stage, and transitions between stages (spec 5.3 and 5.4).

use serde::{Deserialize, Serialize};
use std::f64::consts::LN_2;
use tch::{Kind, Tensor};

/// Upper bound of log u = log(1 − α), so that an opacity of 0 still has a finite logit.
const MAX_LOG_U: f64 = -1e-12;

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

/// Five quantities before activation, of candidates, [B, M, K, ..], or of merged Gaussians, [B, M, G, ..].
#[derive(Debug)]
pub(crate) struct Candidates {
    pub positions: Tensor,      // [.., 3]
    pub log_scales: Tensor,     // [.., 3]
    pub rotations: Tensor,      // [.., 6]
    pub opacity_logits: Tensor, // [.., 1]
    pub sh: Tensor,             // [.., bases · 3]
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
