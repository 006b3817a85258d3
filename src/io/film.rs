//! Moving pictures: GIF by ourselves, MP4 by the ffmpeg on the PATH.

use super::atomic::{partial_file, write_atomically};
use super::images::{padded, rgb_from_tensor};
use crate::error::{Error, Result};
use image::codecs::gif::{GifEncoder, Repeat};
use image::{Delay, Frame, RgbImage};
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;
use tch::Tensor;

/// Writes frames [3, H, W], in [0, 1], as `path` says: `.gif` or `.mp4`. Frames that are smaller than others get a white margin.
///
/// # Errors
/// Another ending, no ffmpeg for `.mp4`, or the system's refusal to write.
pub fn write_film(path: &Path, frames: &[Tensor], frames_per_second: u32) -> Result<()> {
    let frames = padded(frames, &[1, 2]).iter().map(rgb_from_tensor).collect::<Result<Vec<_>>>()?;
    match path.extension().and_then(|e| e.to_str()) {
        Some("gif") => write_gif(path, frames, frames_per_second),
        Some("mp4") => write_mp4(path, &frames, frames_per_second),
        _ => Err(Error::input(path, "the film's ending", path.display(), ".gif or .mp4")),
    }
}

fn write_gif(path: &Path, frames: Vec<RgbImage>, frames_per_second: u32) -> Result<()> {
    // 1 is the best palette, 30 the fastest.
    const SPEED: i32 = 10;
    let mut bytes = vec![];
    let failed =
        |e: image::ImageError| Error::Failed(format!("{}: the film can't be encoded: {e}", path.display()));
    {
        let mut encoder = GifEncoder::new_with_speed(&mut bytes, SPEED);
        encoder.set_repeat(Repeat::Infinite).map_err(failed)?;
        let delay =
            Delay::from_saturating_duration(Duration::from_millis(1000 / u64::from(frames_per_second)));
        for frame in frames {
            let frame = image::DynamicImage::ImageRgb8(frame).into_rgba8();
            encoder.encode_frame(Frame::from_parts(frame, 0, 0, delay)).map_err(failed)?;
        }
    }
    write_atomically(path, |writer| writer.write_all(&bytes).map_err(Error::write(path)))
}

fn write_mp4(path: &Path, frames: &[RgbImage], frames_per_second: u32) -> Result<()> {
    let Some(first) = frames.first() else {
        return Err(Error::Request("a film needs a frame".into()));
    };
    let partial = partial_file(path);
    let size = format!("{}x{}", first.width(), first.height());
    let rate = frames_per_second.to_string();
    let child = Command::new("ffmpeg")
        .args([
            "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", &size, "-r", &rate, "-i", "-",
        ])
        // H.264 in 4:2:0, which every player shows, wants even sides.
        .args(["-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2", "-pix_fmt", "yuv420p", "-f", "mp4"])
        .arg(&partial)
        .stdin(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn();
    let mut child = child.map_err(|e| {
        Error::Request(format!(
            "{} needs ffmpeg, which can't be started ({e}); a path that ends in .gif needs nothing",
            path.display()
        ))
    })?;
    {
        let mut input = child.stdin.take().expect("a pipe was asked for");
        for frame in frames {
            // When ffmpeg ends early, what it says on standard error tells more than the broken pipe.
            if input.write_all(frame).is_err() {
                break;
            }
        }
    }
    let output = child.wait_with_output().map_err(Error::write(path))?;
    if !output.status.success() {
        let _ = std::fs::remove_file(&partial);
        let why = String::from_utf8_lossy(&output.stderr).trim().replace('\n', "; ");
        return Err(Error::Failed(format!("{}: ffmpeg failed: {why}", path.display())));
    }
    let whole = std::fs::File::open(&partial).and_then(|film| film.sync_all());
    whole.and_then(|()| std::fs::rename(&partial, path)).map_err(Error::write(path))
}
