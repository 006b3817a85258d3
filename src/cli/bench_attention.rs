use super::{model, print_json};
use anyhow::Result;
use clap::Args;
use globalsplat::bench::{AttentionReport, bench_attention};
use globalsplat::error::Error;
use tch::Device;

/// Benchmark attention on the CPU, forward and backward: our kernel and libtorch's, compared with a matrix product.
///
/// The default sizes are those of the paper's main model, whose slots attend to 24 photos of 256x256.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat bench attention --threads 1\n  \
    globalsplat bench attention --queries 2057 --keys 2057 --repeats 20 --json")]
pub struct Attention {
    /// Number of query rows
    #[arg(long, value_name = "N", default_value_t = 2053, value_parser = clap::value_parser!(u32).range(1..))]
    queries: u32,
    /// Number of key and value rows
    #[arg(long, value_name = "N", default_value_t = 24_580, value_parser = clap::value_parser!(u32).range(1..))]
    keys: u32,
    /// Width of a row, all heads together
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u16).range(1..))]
    width: u16,
    /// Number of heads
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..))]
    heads: u16,
    /// Precision of queries, keys and values: f32, bf16, or auto: bf16 for wide models if the processor has instructions for it
    #[arg(long, default_value = "f32")]
    precision: String,
    /// Number of threads; by default all cores
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Number of timed calls
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    repeats: u32,
    /// Print the measurements as one JSON object
    #[arg(long)]
    json: bool,
}

impl Attention {
    pub fn run(self) -> Result<()> {
        if let Some(threads) = self.threads {
            tch::set_num_threads(threads.into());
        }
        if !self.width.is_multiple_of(self.heads) {
            let (width, heads) = (self.width, self.heads);
            return Err(Error::request(format!(
                "--width is {width}, expected a multiple of the {heads} heads"
            ))
            .into());
        }
        let sizes = [self.queries.into(), self.keys.into(), self.width.into(), self.heads.into()];
        let asked = model::parse_precision(&self.precision)?;
        let precision = model::precision(asked, Device::Cpu, self.width.into());
        let report = bench_attention(sizes, precision, self.repeats as usize)?;
        if self.json {
            print_json(&serde_json::to_value(&report)?);
        } else {
            print_report(&report, &self);
        }
        Ok(())
    }
}

fn print_report(r: &AttentionReport, asked: &Attention) {
    println!(
        "{} queries, {} keys, {} heads of {}, {}, {}, {} threads; a product of 2048x2048 reaches {:.0} GFLOP/s",
        asked.queries,
        asked.keys,
        asked.heads,
        asked.width / asked.heads,
        r.precision,
        r.simd,
        r.threads,
        r.product_gflops
    );
    println!(
        "{:<10} {:<22} {:>10} {:>10} {:>10} {:>9}",
        "ms a call", "", "median", "min", "GFLOP/s", "share"
    );
    for row in &r.rows {
        let (ms, share) = (&row.milliseconds, 1e2 * row.share);
        println!(
            "{:<10} {:<22} {:>10.2} {:>10.2} {:>10.1} {share:>7.1} %",
            row.pass, row.by, ms.median, ms.min, row.gflops
        );
    }
}
