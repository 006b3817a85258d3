//! Benchmark of attention on the CPU: this crate's kernel, libtorch's, and a matrix product for comparison.

use super::TimingStats;
use super::peak_throughput::PeakThroughput;
use crate::device::Stopwatch;
use crate::model::{Precision, attention, attention_libtorch};
use crate::render::cpu::simd_level;
use serde::Serialize;
use tch::{Device, Kind, Tensor, no_grad};

/// Results of [`bench_attention`].
#[derive(Debug, Serialize)]
pub struct AttentionReport {
    /// Instruction set of this crate's kernel.
    pub simd: String,
    /// Number of threads.
    pub threads: i32,
    /// Precision of queries, keys and values.
    pub precision: Precision,
    /// Throughput of a product of 2048×2048 matrices in the same precision, in GFLOP/s.
    pub product_gflops: f64,
    /// Forward and backward pass of each implementation.
    pub rows: Vec<AttentionRow>,
}

/// One pass of one implementation.
#[derive(Debug, Serialize)]
pub struct AttentionRow {
    /// Name of the pass: `forward` or `backward`.
    pub pass: &'static str,
    /// Implementation: `ours`, `libtorch`, or `libtorch, heads apart` (with each head copied into a contiguous tensor).
    pub by: &'static str,
    /// Time of a call.
    pub milliseconds: TimingStats,
    /// Throughput of the fastest call in GFLOP/s. Backward passes include the operations that recompute the scores.
    pub gflops: f64,
    /// Throughput as a fraction of that of the matrix product.
    pub share: f64,
}

/// Name of an implementation, its function, its inputs, and the gradient of its output.
type Implementation<'a> = (&'static str, &'a dyn Fn([&Tensor; 3]) -> Tensor, &'a [Tensor; 3], &'a Tensor);

/// Times `repeats` calls of each implementation, alternating between them, for `queries` and `keys` with `heads` heads of total width
/// `width`.
///
/// # Errors
/// Fails if `GLOBALSPLAT_SIMD` names an instruction set that this machine doesn't have.
pub fn bench_attention(
    [queries, keys, width, heads]: [i64; 4],
    precision: Precision,
    repeats: usize,
) -> crate::Result<AttentionReport> {
    tch::manual_seed(0);
    let of = |n: i64| Tensor::randn([1, n, width], (Kind::Float, Device::Cpu)).to_kind(precision.kind());
    // Use slices of one layer's output, as in self-attention.
    let of_all = |n: i64| of(n).repeat([1, 1, 3]).chunk(3, -1).swap_remove(1);
    let (inputs, gradient) = ([of_all(queries), of_all(keys), of_all(keys)], of(queries));
    let apart = |t: &Tensor| t.unflatten(-1, [heads, width / heads]).transpose(1, 2).contiguous();
    let (inputs_apart, gradient_apart) = (inputs.each_ref().map(apart), apart(&gradient));
    let torchs = |[q, k, v]: [&Tensor; 3]| {
        Tensor::scaled_dot_product_attention(q, k, v, None::<&Tensor>, 0., false, None, false)
    };
    let implementations: [Implementation; 3] = [
        ("ours", &|[q, k, v]| attention(q, k, v, heads), &inputs, &gradient),
        ("libtorch", &|[q, k, v]| attention_libtorch(q, k, v, heads), &inputs, &gradient),
        ("libtorch, heads apart", &torchs, &inputs_apart, &gradient_apart),
    ];
    let peak = PeakThroughput::new(precision, Device::Cpu);
    let mut product = vec![];
    let mut times = vec![(vec![], vec![]); implementations.len()];
    // The first round warms up caches and threads.
    for round in 0..=repeats {
        let one_product = peak.time()?;
        let mut measured = vec![];
        for (_, call, inputs, gradient) in implementations {
            let mut watch = Stopwatch::default();
            no_grad(|| watch.time("forward", || drop(call(inputs.each_ref()))));
            let leaves = inputs.each_ref().map(|t| t.detach().set_requires_grad(true));
            let objective = (call(leaves.each_ref()) * gradient).sum(Kind::Float);
            watch.time("backward", || objective.backward());
            let sections = watch.sections()?;
            measured.push([0, 1].map(|section| 1e3 * sections[section].1.as_secs_f64()));
        }
        if round > 0 {
            product.push(one_product);
            for ((forward, backward), measured) in times.iter_mut().zip(measured) {
                forward.push(measured[0]);
                backward.push(measured[1]);
            }
        }
    }
    let gflops = |operations: f64, spread: &TimingStats| 1e-6 * operations / spread.min;
    let product_gflops = peak.gflops(TimingStats::from_milliseconds(product).min);
    // Two products forward, five backward.
    let one = 2. * queries as f64 * keys as f64 * width as f64;
    let row = |pass, by, products: f64, milliseconds| {
        let milliseconds = TimingStats::from_milliseconds(milliseconds);
        let gflops = gflops(products * one, &milliseconds);
        AttentionRow { pass, by, milliseconds, gflops, share: gflops / product_gflops }
    };
    let (forward, backward): (Vec<_>, Vec<_>) = times.into_iter().unzip();
    let names = || implementations.iter().map(|implementation| implementation.0);
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
