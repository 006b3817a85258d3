//! The programs in `examples/`, run as a user runs them.

use crate::common::program::{arg, command, room, run_process, tiny_weights};
use std::path::Path;
use std::process::Command;

/// Setting that makes MKL's products bit-identical across programs: otherwise their rounding depends on memory alignment.
const SAME_BITS: (&str, &str) = ("MKL_CBWR", "COMPATIBLE");

/// Returns the standard output of an example that must succeed. `cargo test` builds it; `cargo build --release --examples`
/// builds only the examples.
fn run(name: &str, arguments: &[&str]) -> String {
    let program = Path::new(env!("CARGO_BIN_EXE_globalsplat")).with_file_name("examples").join(name);
    run_process(Command::new(&program).args(arguments).env("OMP_NUM_THREADS", "1").envs([SAME_BITS])).0
}

#[test]
fn reconstruct_makes_the_programs_splat() {
    let (folder, room) = room();
    let weights = tiny_weights(folder.path(), &room);
    let [ours, theirs] = ["example.ply", "program.ply"].map(|name| folder.path().join(name));
    let printed = run("reconstruct", &[arg(&weights), arg(&room), arg(&ours)]);
    assert!(printed.contains("64 Gaussians from 3 photos"), "{printed}");
    let given = ["--weights", arg(&weights), "--scene", arg(&room), "--out", arg(&theirs)];
    let arguments = [&["reconstruct", "--precision", "f32"], &given[..]].concat();
    run_process(command(&arguments).envs([SAME_BITS]));
    assert_eq!(std::fs::read(ours).unwrap(), std::fs::read(theirs).unwrap());
}

#[test]
fn fit_image_fits_an_image() {
    let (folder, room) = room();
    let picture = folder.path().join("fitted.png");
    let printed = run("fit_image", &[arg(&room.join("images/004.png")), arg(&picture), "60"]);
    let numbers: Vec<f64> = printed.split_whitespace().filter_map(|word| word.parse().ok()).collect();
    let [before, steps, after] = numbers[..] else { panic!("{printed}") };
    assert_eq!(steps, 60.);
    assert!(before < 16. && after > before + 10., "{printed}");
    assert_eq!(image::image_dimensions(&picture).unwrap(), (3 * 256 + 2 * 4, 256));
}
