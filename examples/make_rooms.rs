//! Writes captures of small rooms made of Gaussians, each with its splat beside it. The tests and scripts use them.
//!
//! cargo run --release --example make_rooms -- FOLDER SCENES FRAMES SIZE

use std::path::Path;

#[path = "../tests/common/room.rs"]
#[allow(dead_code)]
mod room;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let numbers: Option<Vec<u32>> = arguments.iter().skip(1).map(|number| number.parse().ok()).collect();
    let (Some(folder), Some([scenes, frames, size])) = (arguments.first(), numbers.as_deref()) else {
        eprintln!("usage: make_rooms FOLDER SCENES FRAMES SIZE");
        std::process::exit(2);
    };
    room::write_rooms(Path::new(folder), *scenes, *frames, *size);
}
