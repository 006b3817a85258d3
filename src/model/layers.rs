//! The pieces that streams and mixer are made of, with the initializations of spec 4.4.

use super::parts::{does, part};
use super::precision::Precision;
use globalsplat_csrc::room::expect_room_for_code;
use std::cell::Cell;
use tch::{Device, Tensor, nn, nn::Module};

/// Of encoder linears and learnable tokens.
pub(super) const ENCODER_STD: f64 = 0.02;

/// Normal with mean 0. Where spec 4.4 truncates normals the cut is at ±2, as in torch's `trunc_normal_`: a hundred
/// standard deviations away, so it is the plain normal.
pub(super) fn randn(stdev: f64) -> nn::Init {
    drawn(nn::Init::Randn { mean: 0., stdev })
}

thread_local! {
    static DRAWS: Cell<bool> = const { Cell::new(true) };
}

/// Builds what `build` does, with zeros for random numbers. tch's paths, which every module is built from, have no room for this.
pub(super) fn without_drawing<M>(build: impl FnOnce() -> M) -> M {
    let before = DRAWS.replace(false);
    let built = build();
    DRAWS.set(before);
    built
}

/// `init`, unless nothing is to be drawn.
pub(super) fn drawn(init: nn::Init) -> nn::Init {
    if DRAWS.get() { init } else { nn::Init::Const(0.) }
}

/// A linear layer with normal weights and zero bias.
pub(super) fn linear(vs: nn::Path, inputs: i64, outputs: i64, stdev: f64) -> nn::Linear {
    let config = nn::LinearConfig { ws_init: randn(stdev), bs_init: Some(nn::Init::Const(0.)), bias: true };
    nn::linear(vs, inputs, outputs, config)
}

/// A linear layer with libtorch's own initialization, uniform in ±1/√inputs for weights and bias. (tch's default for
/// weights is another one.)
pub(super) fn default_linear(vs: nn::Path, inputs: i64, outputs: i64, bias: bool) -> nn::Linear {
    let bound = 1. / (inputs as f64).sqrt();
    let uniform = drawn(nn::Init::Uniform { lo: -bound, up: bound });
    nn::linear(vs, inputs, outputs, nn::LinearConfig { ws_init: uniform, bs_init: Some(uniform), bias })
}

/// Of layer normalization.
pub(super) const LAYER_NORM_EPS: f64 = 1e-5;

/// Layer normalization over the last dimension.
pub(super) fn layer_norm(vs: nn::Path, width: i64) -> nn::LayerNorm {
    nn::layer_norm(vs, vec![width], nn::LayerNormConfig { eps: LAYER_NORM_EPS, ..Default::default() })
}

/// `norm` of `xs`.
pub(super) fn normalize(norm: &nn::LayerNorm, xs: &Tensor) -> Tensor {
    part("norms", || {
        let out = norm.forward(xs);
        does(0, 0, &[xs, &out]);
        out
    })
}

/// The gain γ, in float32, of what is added to a stream.
#[derive(Debug)]
pub(super) struct LayerScale {
    gamma: Tensor,
}

impl LayerScale {
    pub fn new(vs: nn::Path, width: i64, init: f64) -> Self {
        LayerScale { gamma: vs.var("gamma", &[width], nn::Init::Const(init)) }
    }

    /// xs + γ ⊙ `change`.
    pub fn add(&self, xs: &Tensor, change: &Tensor) -> Tensor {
        part("residual sums", || {
            let out = xs.addcmul(change, &self.gamma);
            does(0, 0, &[xs, change, &out]);
            out
        })
    }
}

/// W2 · GELU(W1 · x), the exact GELU.
#[derive(Debug)]
pub(super) struct Mlp {
    expand: nn::Linear,
    contract: nn::Linear,
}

impl Mlp {
    /// `names` are those of the two layers in the published weights.
    pub fn new(vs: nn::Path, inputs: i64, hidden: i64, outputs: i64, names: [&str; 2]) -> Self {
        Mlp {
            expand: linear(&vs / names[0], inputs, hidden, ENCODER_STD),
            contract: linear(&vs / names[1], hidden, outputs, ENCODER_STD),
        }
    }

    /// Both layers.
    pub fn products(&self) -> [&nn::Linear; 2] {
        [&self.expand, &self.contract]
    }

    pub fn forward(&self, xs: &Tensor, precision: Precision) -> Tensor {
        part("MLPs", || {
            let hidden = gelu(precision.linear(&self.expand, xs));
            does(0, 0, &[&hidden, &hidden]);
            precision.linear(&self.contract, &hidden)
        })
    }
}

/// x Φ(x) with the normal distribution Φ, in place where nobody asks for gradients.
///
/// # Panics
/// Where the system has no memory for oneDNN's code, by which libtorch does it on a CPU.
pub(super) fn gelu(mut xs: Tensor) -> Tensor {
    if xs.device() == Device::Cpu {
        expect_room_for_code(0).unwrap_or_else(|error| panic!("{error}"));
    }
    if xs.requires_grad() { xs.gelu("none") } else { xs.gelu_("none") }
}
