//! Captures of photos and videos.

mod capture;
mod photos;
mod poses;
mod video;

use globalsplat_colmap::{CaptureOptions, CaptureReport, Colmap, Result, make_capture};
use globalsplat_test_kit::skip;
use image::{Rgb, RgbImage};
use std::path::Path;
use std::process::Command;

/// Writes 4 photos that share nothing.
fn write_noise(folder: &Path) {
    std::fs::create_dir_all(folder).unwrap();
    for index in 0..4u32 {
        let noise = RgbImage::from_fn(200, 200, |x, y| {
            let mut state = (index << 20 | x << 10 | y).wrapping_mul(2_654_435_761);
            state ^= state >> 15;
            state = state.wrapping_mul(2_246_822_519);
            Rgb([(state >> 24) as u8; 3])
        });
        noise.save(folder.join(format!("{index}.png"))).unwrap();
    }
}

/// Makes a capture without stopping.
fn make(source: &Path, out: &Path, options: &CaptureOptions, colmap: &Colmap) -> Result<CaptureReport> {
    make_capture(source, out, options, colmap, &mut |_| true).map(|report| report.expect("nothing stops it"))
}

/// Returns a COLMAP whose commands all fail.
fn failing_colmap() -> Colmap {
    let name = if cfg!(windows) { "colmap.bat" } else { "colmap" };
    Colmap::at(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)).unwrap()
}

/// Returns `true` if there is an ffmpeg with ffprobe; otherwise, skips the test.
fn has_ffmpeg() -> bool {
    let is_missing = |program: &&str| Command::new(program).arg("-version").output().is_err();
    let missing = ["ffmpeg", "ffprobe"].into_iter().find(is_missing);
    missing.inspect(|program| skip("ffmpeg", &format!("{program} isn't on the PATH"))).is_none()
}
