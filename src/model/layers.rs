//! Layers that streams and mixers are built from, with the initializations of spec 4.4.

use super::flops::record_flops;
use super::precision::Precision;
use std::cell::Cell;
use tch::{Tensor, nn, nn::Module};
use tracing::trace_span;

/// Standard deviation of the initial weights of the encoder's linear layers and of learned tokens.
pub(super) const ENCODER_STD: f64 = 0.02;

/// Returns a normal initialization with mean 0. Spec 4.4 truncates normals at ±2, as torch's `trunc_normal_` does. That is a hundred
/// standard deviations away, so this is the plain normal distribution.
pub(super) fn randn(stdev: f64) -> nn::Init {
    init_or_zeros(nn::Init::Randn { mean: 0., stdev })
}

thread_local! {
    static RANDOM_INIT: Cell<bool> = const { Cell::new(true) };
}

/// Runs `build` with zeros in place of random initial weights. tch's `nn::Path`, from which every module is built, has no option for this.
pub(super) fn without_random_init<M>(build: impl FnOnce() -> M) -> M {
    let before = RANDOM_INIT.replace(false);
    let built = build();
    RANDOM_INIT.set(before);
    built
}

/// Returns `init`, or zeros within [`without_random_init`].
pub(super) fn init_or_zeros(init: nn::Init) -> nn::Init {
    if RANDOM_INIT.get() { init } else { nn::Init::Const(0.) }
}

/// Creates a linear layer with normally distributed weights and zero bias.
pub(super) fn linear(vs: nn::Path, inputs: i64, outputs: i64, stdev: f64) -> nn::Linear {
    let config = nn::LinearConfig { ws_init: randn(stdev), bs_init: Some(nn::Init::Const(0.)), bias: true };
    nn::linear(vs, inputs, outputs, config)
}

/// Creates a linear layer with libtorch's own initialization, uniform in ±1/√inputs for weights and bias. (tch's default for weights
/// differs.)
pub(super) fn default_linear(vs: nn::Path, inputs: i64, outputs: i64, bias: bool) -> nn::Linear {
    let bound = 1. / (inputs as f64).sqrt();
    let uniform = init_or_zeros(nn::Init::Uniform { lo: -bound, up: bound });
    nn::linear(vs, inputs, outputs, nn::LinearConfig { ws_init: uniform, bs_init: Some(uniform), bias })
}

/// Epsilon of layer normalization.
pub(super) const LAYER_NORM_EPS: f64 = 1e-5;

/// Creates a layer normalization over the last dimension.
pub(super) fn layer_norm(vs: nn::Path, width: i64) -> nn::LayerNorm {
    nn::layer_norm(vs, vec![width], nn::LayerNormConfig { eps: LAYER_NORM_EPS, ..Default::default() })
}

/// Applies `norm` to `xs`.
pub(super) fn normalize(norm: &nn::LayerNorm, xs: &Tensor) -> Tensor {
    trace_span!("norms").in_scope(|| {
        let out = norm.forward(xs);
        record_flops(0, 0, &[xs, &out]);
        out
    })
}

/// Learned gain γ, in float32, of an update that is added to a stream.
#[derive(Debug)]
pub(super) struct LayerScale {
    gamma: Tensor,
}

impl LayerScale {
    pub fn new(vs: nn::Path, width: i64, init: f64) -> Self {
        LayerScale { gamma: vs.var("gamma", &[width], nn::Init::Const(init)) }
    }

    /// Returns xs + γ ⊙ `change`.
    pub fn add(&self, xs: &Tensor, change: &Tensor) -> Tensor {
        trace_span!("residual sums").in_scope(|| {
            let out = xs.addcmul(change, &self.gamma);
            record_flops(0, 0, &[xs, change, &out]);
            out
        })
    }
}

/// Two-layer perceptron W2 · GELU(W1 · x) with the exact GELU.
#[derive(Debug)]
pub(super) struct Mlp {
    expand: nn::Linear,
    contract: nn::Linear,
}

impl Mlp {
    /// Creates both layers; `names` are their names in the published weights.
    pub fn new(vs: nn::Path, inputs: i64, hidden: i64, outputs: i64, names: [&str; 2]) -> Self {
        Mlp {
            expand: linear(&vs / names[0], inputs, hidden, ENCODER_STD),
            contract: linear(&vs / names[1], hidden, outputs, ENCODER_STD),
        }
    }

    /// Returns both linear layers.
    pub fn linear_layers(&self) -> [&nn::Linear; 2] {
        [&self.expand, &self.contract]
    }

    pub fn forward(&self, xs: &Tensor, precision: Precision) -> Tensor {
        trace_span!("MLPs").in_scope(|| {
            let hidden = gelu(precision.linear(&self.expand, xs));
            record_flops(0, 0, &[&hidden, &hidden]);
            precision.linear(&self.contract, &hidden)
        })
    }
}

/// Computes x Φ(x) with the cumulative normal distribution Φ, in place if no gradients are needed.
pub(super) fn gelu(mut xs: Tensor) -> Tensor {
    if xs.requires_grad() { xs.gelu("none") } else { xs.gelu_("none") }
}
