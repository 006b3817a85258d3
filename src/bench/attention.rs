//! Attention on the CPU: our kernel beside libtorch's, and both beside a matrix product.

use super::Spread;
use super::yardstick::Yardstick;
use crate::model::{Precision, attention, by_libtorch};
use crate::optim::Stopwatch;
use crate::render::cpu::simd_level;
use serde::Serialize;
use tch::{Device, Kind, Tensor, no_grad};

/// What [`bench_attention`] measured.
#[derive(Debug, Serialize)]
pub struct AttentionReport {
    /// Instruction set of our kernel.
    pub simd: String,
    /// Threads that shared the work.
    pub threads: i32,
    /// Of queries, keys and values.
    pub precision: Precision,
    /// A product of matrices of 2048×2048 in the same precision, in 10⁹ floating-point operations a second.
    pub product_gflops: f64,
    /// Forward and backward, each by whom it is computed.
    pub rows: Vec<AttentionRow>,
}

/// One pass in one way.
#[derive(Debug, Serialize)]
pub struct AttentionRow {
    /// forward or backward.
    pub pass: &'static str,
    /// ours, libtorch's, or libtorch's on heads that were copied apart.
    pub by: &'static str,
    /// A call.
    pub milliseconds: Spread,
    /// Of the fastest call, in 10⁹ floating-point operations a second; of backward passes those of recomputed scores count.
    pub gflops: f64,
    /// Of it, what the product reaches.
    pub share: f64,
}

/// By whom, how, of what, and the gradient of what comes out.
type Way<'a> = (&'static str, &'a dyn Fn([&Tensor; 3]) -> Tensor, &'a [Tensor; 3], &'a Tensor);

/// Times `repeats` calls of each, by turns, for `queries` and `keys` of `heads` heads that are `width` wide together.
///
/// # Errors
/// An instruction set that the machine doesn't have.
pub fn bench_attention(
    [queries, keys, width, heads]: [i64; 4],
    precision: Precision,
    repeats: usize,
) -> crate::Result<AttentionReport> {
    tch::manual_seed(0);
    let of = |n: i64| Tensor::randn([1, n, width], (Kind::Float, Device::Cpu)).to_kind(precision.kind());
    // As self-attention has them: parts of what one layer gave.
    let of_all = |n: i64| of(n).repeat([1, 1, 3]).chunk(3, -1).swap_remove(1);
    let (inputs, gradient) = ([of_all(queries), of_all(keys), of_all(keys)], of(queries));
    let apart = |t: &Tensor| t.unflatten(-1, [heads, width / heads]).transpose(1, 2).contiguous();
    let (inputs_apart, gradient_apart) = (inputs.each_ref().map(apart), apart(&gradient));
    let torchs = |[q, k, v]: [&Tensor; 3]| {
        Tensor::scaled_dot_product_attention(q, k, v, None::<&Tensor>, 0., false, None, false)
    };
    let ways: [Way; 3] = [
        ("ours", &|[q, k, v]| attention(q, k, v, heads), &inputs, &gradient),
        ("libtorch", &|[q, k, v]| by_libtorch(q, k, v, heads), &inputs, &gradient),
        ("libtorch, heads apart", &torchs, &inputs_apart, &gradient_apart),
    ];
    let yardstick = Yardstick::new(precision, Device::Cpu);
    let mut product = vec![];
    let mut times = vec![(vec![], vec![]); ways.len()];
    // The first round warms caches and threads up.
    for round in 0..=repeats {
        let one_product = yardstick.time();
        let mut measured = vec![];
        for (_, call, inputs, gradient) in ways {
            let mut watch = Stopwatch::default();
            no_grad(|| watch.time("forward", || drop(call(inputs.each_ref()))));
            let leaves = inputs.each_ref().map(|t| t.detach().set_requires_grad(true));
            let objective = (call(leaves.each_ref()) * gradient).sum(Kind::Float);
            watch.time("backward", || objective.backward());
            measured.push([0, 1].map(|section| 1e3 * watch.sections()[section].1.as_secs_f64()));
        }
        if round > 0 {
            product.push(one_product);
            for ((forward, backward), measured) in times.iter_mut().zip(measured) {
                forward.push(measured[0]);
                backward.push(measured[1]);
            }
        }
    }
    let gflops = |operations: f64, spread: &Spread| 1e-6 * operations / spread.least;
    let product_gflops = yardstick.gflops(Spread::of(product).least);
    // Two products forward, five backward.
    let one = 2. * queries as f64 * keys as f64 * width as f64;
    let row = |pass, by, products: f64, milliseconds| {
        let milliseconds = Spread::of(milliseconds);
        let gflops = gflops(products * one, &milliseconds);
        AttentionRow { pass, by, milliseconds, gflops, share: gflops / product_gflops }
    };
    let (forward, backward): (Vec<_>, Vec<_>) = times.into_iter().unzip();
    let names = || ways.iter().map(|way| way.0);
    let rows = names().zip(forward).map(|(by, times)| row("forward", by, 2., times));
    let rows = rows.chain(names().zip(backward).map(|(by, times)| row("backward", by, 5., times))).collect();
    Ok(AttentionReport {
        simd: simd_level()?,
        threads: tch::get_num_threads(),
        precision,
        product_gflops,
        rows,
    })
}
