//! The programs in `examples/`, run as a user runs them.

use crate::common::program::{Sandbox, run_process};
use std::path::Path;
use std::process::Command;

/// Setting that makes MKL's products bit-identical across programs: otherwise their rounding depends on memory alignment.
const SAME_BITS: (&str, &str) = ("MKL_CBWR", "COMPATIBLE");

/// Returns the standard output of an example that must succeed. `cargo test` builds it; `cargo build --release --examples`
/// builds only the examples.
fn run(name: &str, arguments: &[&Path]) -> String {
    let program = Path::new(env!("CARGO_BIN_EXE_globalsplat")).with_file_name("examples").join(name);
    run_process(Command::new(&program).args(arguments).env("OMP_NUM_THREADS", "1").envs([SAME_BITS])).0
}

#[test]
fn reconstruct_makes_the_programs_splat() {
    let sandbox = Sandbox::with_weights();
    let [weights, room, ours] = ["tiny.safetensors", "room", "example.ply"].map(|name| sandbox.path(name));
    let printed = run("reconstruct", &[&weights, &room, &ours]);
    assert!(printed.contains("64 Gaussians from 3 photos"), "{printed}");
    let line = "reconstruct --precision f32 --weights @tiny.safetensors --scene @room --out @program.ply";
    run_process(sandbox.command(line).envs([SAME_BITS]));
    assert_eq!(sandbox.read("example.ply"), sandbox.read("program.ply"));
}

#[test]
fn fit_image_fits_an_image() {
    let sandbox = Sandbox::new();
    let [image, fitted] = ["room/images/004.png", "fitted.png"].map(|name| sandbox.path(name));
    let printed = run("fit_image", &[&image, &fitted, Path::new("60")]);
    let numbers: Vec<f64> = printed.split_whitespace().filter_map(|word| word.parse().ok()).collect();
    let [before, steps, after] = numbers[..] else { panic!("{printed}") };
    assert_eq!(steps, 60.);
    assert!(before < 16. && after > before + 10., "{printed}");
    assert_eq!(image::image_dimensions(&fitted).unwrap(), (3 * 256 + 2 * 4, 256));
}
