//! Layers that the model is built from, with the initializations of spec 4.4. Each is a span, whose time `bench` measures.

use super::precision::{Precision, record_op, record_work};
use crate::ffi::take_tensor;
use globalsplat_csrc::runtime::{Bf16Support, cpu_bf16_support};
use globalsplat_csrc::tensor_ops as ours;
use std::cell::Cell;
use tch::{Device, Kind, Tensor, nn, nn::Module};
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

/// Applies `layer` to `xs`: a projection of a stream to queries, to queries, keys and values, or of attention's output.
pub(super) fn project(layer: &nn::Linear, xs: &Tensor, precision: Precision) -> Tensor {
    trace_span!("queries and outputs").in_scope(|| precision.linear(layer, xs))
}

/// Epsilon of layer normalization.
const LAYER_NORM_EPS: f64 = 1e-5;

/// Creates a layer normalization over the last dimension.
pub(super) fn layer_norm(vs: nn::Path, width: i64) -> nn::LayerNorm {
    nn::layer_norm(vs, vec![width], nn::LayerNormConfig { eps: LAYER_NORM_EPS, ..Default::default() })
}

/// Applies `norm` to `xs`.
pub(super) fn normalize(norm: &nn::LayerNorm, xs: &Tensor) -> Tensor {
    record_op(trace_span!("norms"), &[xs], || norm.forward(xs))
}

/// Normalizes `xs` over the last dimension without γ and β.
pub(super) fn normalize_without_affine(xs: &Tensor) -> Tensor {
    let width = *xs.size().last().expect("a last dimension");
    record_op(trace_span!("norms"), &[xs], || {
        xs.layer_norm([width], None::<&Tensor>, None::<&Tensor>, LAYER_NORM_EPS, true)
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
        record_op(trace_span!("residual sums"), &[xs, change], || xs.addcmul(change, &self.gamma))
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
            record_work(0, 0, &[&hidden, &hidden]);
            precision.linear(&self.contract, &hidden)
        })
    }
}

/// Computes x Φ(x) with the cumulative normal distribution Φ, in place if no gradients are needed.
pub(super) fn gelu(mut xs: Tensor) -> Tensor {
    if xs.requires_grad() { xs.gelu("none") } else { xs.gelu_("none") }
}

/// Computes softmax(q kᵀ / √(d/h)) v over `heads` heads (spec 4.2), by our own kernel where it is fastest and by libtorch elsewhere. q is
/// [B, n, d], k and v are [B, m, d]; the result is [B, n, d] and of their kind.
pub(crate) fn attention(q: &Tensor, k: &Tensor, v: &Tensor, heads: i64) -> Tensor {
    let out = dispatch_attention(q, k, v, heads);
    let size = q.size();
    let flops = 4 * size[0] * size[1] * k.size()[1] * size[2];
    // The backward pass recomputes the scores, and computes gradients of queries, keys, attention weights and values.
    record_work(flops, if out.requires_grad() { 5 * flops / 2 } else { 0 }, &[q, k, v, &out]);
    out
}

fn dispatch_attention(q: &Tensor, k: &Tensor, v: &Tensor, heads: i64) -> Tensor {
    let (kind, width, all) = (q.kind(), q.size()[2] / heads, [q, k, v]);
    let fits = |t: &&Tensor| t.device() == Device::Cpu && t.kind() == kind && t.size()[1] > 0;
    if !all.iter().all(fits) {
        return attention_libtorch(q, k, v, heads);
    }
    let takes = |is_bf16| ours::supports_attention(width, is_bf16).unwrap_or_else(|error| panic!("{error}"));
    match kind {
        Kind::Float if takes(false) => attention_cpu_kernel(all, heads),
        Kind::BFloat16 if takes(true) => attention_cpu_kernel(all, heads),
        // Our kernel lacks bf16 products on this CPU, and libtorch's bf16 kernel is fast only with tiles (AMX): compute in float32.
        Kind::BFloat16 if cpu_bf16_support() != Bf16Support::Tiles && takes(false) => {
            attention_cpu_kernel(all.map(|t| t.to_kind(Kind::Float)).each_ref(), heads).to_kind(kind)
        }
        _ => attention_libtorch(q, k, v, heads),
    }
}

fn attention_cpu_kernel(all: [&Tensor; 3], heads: i64) -> Tensor {
    let [q, k, v] = all.map(|t| t.as_ptr() as usize);
    // SAFETY: the tensors outlive the call, which returns the address of a new one.
    let out = unsafe { ours::attention(q, k, v, heads) };
    unsafe { take_tensor(out.unwrap_or_else(|error| panic!("{error}"))) }
}

/// Computes [`attention`] with libtorch, on any device and for any kind and width.
fn attention_libtorch(q: &Tensor, k: &Tensor, v: &Tensor, heads: i64) -> Tensor {
    let split = |t: &Tensor| {
        let (b, n, d) = t.size3().expect("[B, n, d]");
        t.view([b, n, heads, d / heads]).transpose(1, 2) // [B, h, n, d/h]
    };
    // The strides are those of the linear layers, the kinds agree and there is no mask. libtorch's fused kernels then take the tensors
    // without a copy, provided that a head's width is a multiple of 8.
    Tensor::scaled_dot_product_attention(
        &split(q),
        &split(k),
        &split(v),
        None::<&Tensor>,
        0.,
        false,
        None,
        false,
    )
    .transpose(1, 2)
    .flatten(2, 3)
}

#[cfg(test)]
mod tests {
    use super::*;
    use globalsplat_csrc::render::simd_level;
    use globalsplat_csrc::runtime::set_num_threads;
    use globalsplat_test_kit::exit_code_of_test;
    use std::path::Path;
    use tch::no_grad;

    const NAMES: [&str; 3] = ["attn_out", "slots", "tokens"];

    /// Returns the output and the gradients of queries, keys and values, for sizes that are split among threads: blocks of 516 queries and
    /// of 384 keys, each with a remainder.
    fn answers(kind: Kind) -> Vec<Tensor> {
        let of = |n: i64| {
            // Irregular values without the random generator, which other tests share.
            let numbers = Tensor::arange(2 * n * 3 * 64, (Kind::Double, Device::Cpu)).square().sin() * 1.5;
            numbers.to_kind(kind).view([2, n, 3 * 64]).set_requires_grad(true)
        };
        let (slots, tokens) = (of(530), of(1000));
        let (of_slots, of_tokens) = (slots.chunk(3, -1), tokens.chunk(3, -1));
        let cross = attention(&of_slots[0], &of_tokens[1], &of_tokens[2], 2);
        let among = attention(&of_slots[0], &of_slots[1], &of_slots[2], 2);
        ((&cross + among) * cross.detach().cos()).sum(Kind::Float).backward();
        vec![cross.detach(), slots.grad(), tokens.grad()]
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        for kind in [Kind::Float, Kind::BFloat16] {
            let expected = answers(kind);
            for threads in [1, 2, 3] {
                set_num_threads(threads);
                let found = answers(kind);
                set_num_threads(0);
                assert!(expected.iter().zip(&found).all(|(a, b)| a.equal(b)), "{kind:?}, {threads} threads");
            }
        }
    }

    #[test]
    fn instruction_sets_agree() {
        // The instruction set is chosen once per process, so this test runs itself in a new process for every set, which computes and
        // saves.
        const OUT: &str = "GLOBALSPLAT_TEST_OUT";
        const UNSUPPORTED: i32 = 77;
        if let Some(out) = std::env::var_os(OUT) {
            if simd_level().is_err() {
                std::process::exit(UNSUPPORTED);
            }
            let named: Vec<_> = NAMES.into_iter().zip(answers(Kind::Float)).collect();
            return Tensor::write_safetensors(&named, out).expect("a writable file");
        }
        let folder = tempfile::tempdir().expect("a temporary folder");
        let expected = answers(Kind::Float);
        for level in ["avx512", "avx2", "neon", "portable"] {
            let out = folder.path().join(level);
            let variables = [("GLOBALSPLAT_SIMD", Path::new(level)), (OUT, &out)];
            let code = exit_code_of_test("model::layers::tests::instruction_sets_agree", &variables);
            if code == Some(UNSUPPORTED) {
                continue;
            }
            assert_eq!(code, Some(0), "{level}");
            let found = Tensor::read_safetensors(&out).expect("what was written");
            assert_eq!(found.len(), NAMES.len());
            for (name, found) in &found {
                let place = NAMES.iter().position(|known| known == name).expect("a name that was written");
                let expected = &expected[place];
                let error = (found - expected).norm() / expected.norm();
                assert!(error.double_value(&[]) < 1e-6, "{level}: {name} differs by {error}");
            }
        }
    }

    #[test]
    fn shapes_that_dont_fit_are_refused() {
        let of = |n: i64, d: i64| Tensor::zeros([1, n, d], (Kind::Float, Device::Cpu));
        let refused = |q: &Tensor, k: &Tensor, v: &Tensor, heads: i64| {
            let [q, k, v] = [q, k, v].map(|t| t.as_ptr() as usize);
            unsafe { ours::attention(q, k, v, heads) }.expect_err("refused").to_string()
        };
        let said = refused(&of(3, 16), &of(4, 16), &of(5, 16), 2);
        assert!(said.contains("keys [1, 4, 16] and values [1, 5, 16], expected"), "{said}");
        let said = refused(&of(3, 18), &of(4, 18), &of(4, 18), 2);
        assert!(
            said.contains("have 2 heads, expected a head width of at most 128 that is a multiple of 4"),
            "{said}"
        );
        let double = of(3, 16).to_kind(Kind::Double);
        let said = refused(&double, &double, &double, 2);
        assert!(said.contains("must be float32 on the CPU"), "{said}");
        // Attention to no keys is left to libtorch.
        let nothing = of(0, 16);
        let seen = no_grad(|| attention(&of(3, 16), &nothing, &nothing, 2));
        assert_eq!(seen.size(), [1, 3, 16]);
    }
}
