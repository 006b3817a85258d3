//! Synthetic video for benchmarks: frames that are as hard to decode as photos, in chunks like those of RealEstate10K.

use crate::data::{ChunkWriter, open_capture, write_cameras_json};
use crate::error::{Error, Result};
use crate::scene::{Camera, Intrinsics};
use glam::{DMat4, DVec3};
use image::{Rgb, RgbImage, imageops};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use std::path::Path;

/// Size of a frame in pixels, as in RealEstate10K.
const WIDTH: u32 = 640;
const HEIGHT: u32 = 360;
/// JPEG quality. A frame takes about 45 KB, with colours at half the resolution as in video.
const QUALITY: u8 = 95;
/// Horizontal offset between consecutive frames, in pixels.
const STEP: u32 = 2;

/// Writes `videos` videos of `frames` frames in chunks of about `chunk_bytes` to the existing folder `root`.
pub(super) fn write_videos(root: &Path, videos: usize, frames: usize, chunk_bytes: usize) -> Result<()> {
    let mut writer = ChunkWriter::new(root, chunk_bytes)?;
    let folder = root.join(format!(".globalsplat-frames-{}", std::process::id()));
    std::fs::create_dir(&folder).map_err(Error::write(&folder))?;
    for video in 0..videos {
        // A capture is named after its folder.
        let capture = folder.join(format!("video_{video:03}"));
        std::fs::create_dir(&capture).map_err(Error::write(&capture))?;
        let panorama = panorama(WIDTH + STEP * frames as u32, video as u64);
        let names: Vec<String> = (0..frames).map(|frame| format!("{frame:04}.jpg")).collect();
        for (frame, name) in names.iter().enumerate() {
            let seen = imageops::crop_imm(&panorama, STEP * frame as u32, 0, WIDTH, HEIGHT).to_image();
            let file = capture.join(name);
            std::fs::write(&file, encode(&seen)?).map_err(Error::write(&file))?;
        }
        write_cameras_json(&capture.join("cameras.json"), &names, &cameras(frames))?;
        writer.add(&open_capture(&capture)?)?;
        std::fs::remove_dir_all(&capture).map_err(Error::write(&capture))?;
    }
    std::fs::remove_dir_all(&folder).map_err(Error::write(&folder))?;
    writer.finish()?;
    Ok(())
}

fn encode(frame: &RgbImage) -> Result<Vec<u8>> {
    let mut bytes = vec![];
    let mut encoder = Encoder::new(&mut bytes, QUALITY);
    encoder.set_sampling_factor(SamplingFactor::R_4_2_0);
    let encoded = encoder.encode(frame.as_raw(), WIDTH as u16, HEIGHT as u16, ColorType::Rgb);
    encoded.map_err(Error::failed_with_context("a frame can't be encoded"))?;
    Ok(bytes)
}

/// Returns cameras that move to the right at a constant speed.
fn cameras(frames: usize) -> Vec<Camera> {
    let (width, height) = (f64::from(WIDTH), f64::from(HEIGHT));
    let intrinsics = Intrinsics { fx: 0.5 * width, fy: 0.5 * width, cx: width / 2., cy: height / 2. };
    let at = |frame: usize| DMat4::from_translation(DVec3::new(0.02 * frame as f64, 0., 0.));
    (0..frames).map(|frame| Camera { intrinsics, c2w: at(frame), width: WIDTH, height: HEIGHT }).collect()
}

/// Returns a sum of octaves of noise whose amplitudes fall off as in photos. Fine octaves are grey, as fine detail is in photos.
fn panorama(width: u32, seed: u64) -> RgbImage {
    const OCTAVES: i32 = 7;
    const GREY_FROM: i32 = 4;
    const FALL_OFF: f64 = 0.62;
    let sum: f64 = (0..OCTAVES).map(|octave| FALL_OFF.powi(octave)).sum();
    RgbImage::from_fn(width, HEIGHT, |x, y| {
        let mut colour = [0.; 3];
        for octave in 0..OCTAVES {
            let scale = 2f64.powi(octave) / 128.;
            let (u, v) = (f64::from(x) * scale, f64::from(y) * scale);
            let of = |channel: u64| noise(u, v, seed * 100 + octave as u64 * 3 + channel);
            let grey = if octave < GREY_FROM { None } else { Some(of(0)) };
            for (channel, value) in colour.iter_mut().enumerate() {
                *value += FALL_OFF.powi(octave) * grey.unwrap_or_else(|| of(channel as u64));
            }
        }
        // Sums of noise stay near the middle, so stretch them to the whole range.
        Rgb(colour.map(|value| (255. * (0.5 + 1.6 * (value / sum - 0.5))) as u8))
    })
}

/// Interpolates smoothly between random values at integer coordinates. The result is in [0, 1].
fn noise(x: f64, y: f64, seed: u64) -> f64 {
    let (left, top) = (x.floor(), y.floor());
    let smooth = |t: f64| t * t * (3. - 2. * t);
    let (s, t) = (smooth(x - left), smooth(y - top));
    let at = |dx: i64, dy: i64| random(left as i64 + dx, top as i64 + dy, seed);
    let mix = |a: f64, b: f64, s: f64| a + s * (b - a);
    mix(mix(at(0, 0), at(1, 0), s), mix(at(0, 1), at(1, 1), s), t)
}

fn random(x: i64, y: i64, seed: u64) -> f64 {
    let mut bits =
        (x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
    bits ^= seed.wrapping_mul(0x1656_67b1_9e37_79f9);
    bits = (bits ^ bits >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    ((bits >> 33) & 0xffff) as f64 / 65_535.
}
