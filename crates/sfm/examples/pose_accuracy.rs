//! Measures how exact the poses of `make_capture` are, on photos of two synthetic scenes, whose poses are known. Prints two rows of a
//! Markdown table for each case that the arguments name, or for all of them:
//!
//! ```sh
//! cargo run --release -p globalsplat-sfm --example pose_accuracy -- photos video fisheye panorama
//! ```

use glam::DMat4;
use globalsplat_capture::{ImageSize, Lens, encode_photo, open_capture};
use globalsplat_sfm::{CaptureOptions, Colmap, PoseOptions, make_capture};
use globalsplat_synth::{Video, VideoSettings};
use globalsplat_test_kit::pose_errors;
use image::RgbImage;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::error::Error;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

/// Names of the scenes, and their numbers among those of seed 1.
const SCENES: [(&str, u64); 2] = [("a room", 3), ("outdoors, around an object", 10)];
/// Frames per second of the video.
const FPS: f64 = 30.;

/// What is photographed, and how.
struct Case {
    name: &'static str,
    description: &'static str,
    frames: usize,
    size: ImageSize,
    /// Model and parameters of the lens, as COLMAP defines them. The model is given to COLMAP, the parameters aren't. `None` stands for a
    /// pinhole camera, of which COLMAP is told nothing.
    lens: Option<(&'static str, &'static [f64])>,
    is_video: bool,
}

const CASES: [Case; 4] = [
    Case {
        name: "photos",
        description: "24 photos of 640×480",
        frames: 24,
        size: ImageSize { height: 480, width: 640 },
        lens: None,
        is_video: false,
    },
    Case {
        name: "video",
        description: "video of 150 frames of 640×480",
        frames: 150,
        size: ImageSize { height: 480, width: 640 },
        lens: None,
        is_video: true,
    },
    Case {
        name: "fisheye",
        description: "24 photos of 960×720, fisheye of 150°",
        frames: 24,
        size: ImageSize { height: 720, width: 960 },
        lens: Some(("OPENCV_FISHEYE", &[360., 361., 478., 363., 0.03, -0.01, 0.001, 0.])),
        is_video: false,
    },
    Case {
        name: "panorama",
        description: "24 photos of 1600×800, 360°",
        frames: 24,
        size: ImageSize { height: 800, width: 1600 },
        lens: Some(("EQUIRECTANGULAR", &[1600., 800.])),
        is_video: false,
    },
];

fn main() -> Result<(), Box<dyn Error>> {
    let names: Vec<String> = std::env::args().skip(1).collect();
    if let Some(unknown) = names.iter().find(|name| CASES.iter().all(|case| case.name != **name)) {
        return Err(format!("the case is {unknown}, expected photos, video, fisheye or panorama").into());
    }
    let colmap = Colmap::find()?;
    println!("| photos | scene | placed | largest position error | median | largest rotation error | time |");
    println!("|---|---|---|---|---|---|---|");
    for case in CASES.iter().filter(|case| names.is_empty() || names.iter().any(|name| name == case.name)) {
        for scene in SCENES {
            println!("{}", measure(case, scene, &colmap)?);
        }
    }
    Ok(())
}

/// Makes a capture of a case in a temporary folder, and returns its row of the table.
fn measure(case: &Case, (place, number): (&str, u64), colmap: &Colmap) -> Result<String, Box<dyn Error>> {
    let settings = VideoSettings { frames: case.frames, size: case.size, pictures: vec![] };
    let scene = Video::new(1, number, &settings);
    let lens = case.lens.map(|(model, parameters)| Lens::from_colmap(model, parameters, case.size));
    let lens = lens.transpose().map_err(|(field, ..)| field)?;
    let render = |frame| match &lens {
        Some(lens) => scene.photo_through(frame, lens),
        None => scene.photo(frame),
    };
    let photos: Vec<RgbImage> = (0..case.frames).into_par_iter().map(render).collect();

    let folder = tempfile::tempdir()?;
    let [source, out] = ["source", "out"].map(|name| folder.path().join(name));
    match case.is_video {
        true => write_video(&source, &photos)?,
        false => write_photos(&source, &photos)?,
    }
    let poses = PoseOptions { camera_model: case.lens.map(|(model, _)| model.into()), ..Default::default() };
    let options = CaptureOptions { poses, ..Default::default() };
    let start = Instant::now();
    let report = make_capture(&source, &out, &options, colmap, |_| true)?.expect("nothing stops it");
    let seconds = start.elapsed().as_secs_f64();
    eprintln!("{}, {place}: {}", case.name, report.poses);

    // The photo's pose is that of its only view, or of the front one. Photos are numbered from 0, and frames of a video from 1.
    let capture = open_capture(&out)?;
    let mut found = BTreeMap::new();
    for (name, camera) in capture.names().zip(capture.cameras()) {
        let (photo, view) = name.trim_end_matches(".jpg").split_once('@').unwrap_or((name, "front"));
        if view == "front" {
            let digits: String = photo.chars().filter(char::is_ascii_digit).collect();
            found.insert(digits.parse::<usize>()?, camera.c2w);
        }
    }
    let true_frame = |number: usize| match &report.video {
        Some(video) => (video.times[number - 1] * FPS).round() as usize,
        None => number,
    };
    let truth: Vec<DMat4> = found.keys().map(|&number| scene.cameras()[true_frame(number)].c2w).collect();
    let (mut positions, angles): (Vec<f64>, Vec<f64>) =
        pose_errors(&found.into_values().collect::<Vec<_>>(), &truth).into_iter().unzip();
    positions.sort_by(f64::total_cmp);
    Ok(format!(
        "| {} | {place} | {} of {} | {:.3} % | {:.3} % | {:.3}° | {seconds:.0} s |",
        case.description,
        positions.len(),
        report.poses.photos,
        100. * positions[positions.len() - 1],
        100. * positions[positions.len() / 2],
        angles.into_iter().fold(0., f64::max),
    ))
}

fn write_photos(folder: &Path, photos: &[RgbImage]) -> Result<(), Box<dyn Error>> {
    std::fs::create_dir(folder)?;
    for (index, photo) in photos.iter().enumerate() {
        std::fs::write(folder.join(format!("{index:03}.jpg")), encode_photo(photo, true)?)?;
    }
    Ok(())
}

/// Encodes a video in H.264.
fn write_video(file: &Path, frames: &[RgbImage]) -> Result<(), Box<dyn Error>> {
    let (size, fps) = (format!("{}x{}", frames[0].width(), frames[0].height()), FPS.to_string());
    let mut ffmpeg = Command::new("ffmpeg")
        .args(["-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", &size, "-r", &fps, "-i", "-"])
        .args(["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-f", "mp4"])
        .arg(file)
        .stdin(Stdio::piped())
        .spawn()?;
    let mut input = ffmpeg.stdin.take().expect("a pipe was requested");
    frames.iter().try_for_each(|frame| input.write_all(frame.as_raw()))?;
    drop(input);
    match ffmpeg.wait()?.success() {
        true => Ok(()),
        false => Err("ffmpeg can't encode the video".into()),
    }
}
