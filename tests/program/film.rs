//! Videos and camera paths: what players decode, the sources of cameras, and cleanup after failures.

use crate::common::formats::{Format, rewrite};
use crate::common::program::{Sandbox, arg, assert_says, send_signal, wait_for};
use crate::common::{pictures, psnr, skip, write_script};
use glam::{DMat4, DVec4};
use globalsplat::data::{open_capture, read_camera_path, write_cameras_json};
use globalsplat::io::find_ffmpeg;
use globalsplat::scene::{Camera, pose_to_rows};
use image::RgbImage;
use serde_json::{Value, json};
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use tempfile::TempDir;

/// Returns `true` if there is an ffmpeg that writes MP4s; otherwise, skips the test.
fn has_ffmpeg() -> bool {
    find_ffmpeg().map_err(|why| skip("ffmpeg", &why)).is_ok()
}

/// Returns the description of a video's stream by ffprobe.
fn probed(film: &Path) -> Value {
    let output = Command::new("ffprobe")
        .args(["-v", "error", "-count_frames", "-show_streams", "-of", "json", arg(film)])
        .output()
        .unwrap();
    let mut report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["streams"].as_array().unwrap().len(), 1, "pictures alone");
    report["streams"][0].take()
}

#[test]
fn an_mp4_shows_what_the_pictures_show() {
    if !has_ffmpeg() {
        return;
    }
    let sandbox = Sandbox::new();
    let render = "render --splat @room/truth.ply --scene @room --size 384x256 --depth";
    sandbox.run(&format!("{render} --fps 25 --out @film.mp4"));
    let film = sandbox.path("film.mp4");
    let found = probed(&film);
    for (key, expected) in [
        ("codec_name", "h264"),
        ("pix_fmt", "yuv420p"),
        ("r_frame_rate", "25/1"),
        ("nb_read_frames", "9"),
        ("color_space", "bt709"),
        ("color_range", "tv"),
    ] {
        assert_eq!(found[key], expected, "{key}: {found}");
    }
    // Color and depth side by side, with a gap.
    assert_eq!((found["width"].as_i64(), found["height"].as_i64()), (Some(2 * 384 + 4), Some(256)));
    let bytes = sandbox.read("film.mp4");
    let at = |name: &[u8]| bytes.windows(4).position(|four| four == name).unwrap();
    assert!(at(b"moov") < at(b"mdat"), "a page would have to load all of it first");

    // Another program decodes the video, and its frames are compared with PNGs from the same cameras.
    let decoded = Command::new("ffmpeg")
        .args(["-v", "error", "-i", arg(&film), "-sws_flags", "accurate_rnd+full_chroma_int+bicubic"])
        .args(["-f", "rawvideo", "-pix_fmt", "rgb24", "-"])
        .output()
        .unwrap()
        .stdout;
    let frames =
        decoded.chunks(3 * 772 * 256).map(|frame| RgbImage::from_raw(772, 256, frame.to_vec()).unwrap());
    let frames: Vec<RgbImage> = frames.collect();
    assert_eq!(frames.len(), 9);
    sandbox.run(&format!("{render} --out @views"));
    let parts = pictures(&sandbox.path("views"));
    for (i, (frame, parts)) in frames.iter().zip(parts.chunks(2)).enumerate() {
        let mut picture = RgbImage::from_pixel(772, 256, image::Rgb([255; 3]));
        // Sorted by name: 000.png, then 000_depth.png.
        image::imageops::replace(&mut picture, &parts[0], 0, 0);
        image::imageops::replace(&mut picture, &parts[1], 388, 0);
        let likeness = psnr(frame, &picture);
        println!("frame {i}: {likeness:.1} dB");
        assert!(likeness > 33., "frame {i} of the film is {likeness} dB like its picture");
    }

    // An odd side is cropped by one line, and nothing else.
    sandbox.run("render --splat @room/truth.ply --scene @room --size 33x41 --out @odd.mp4");
    let found = probed(&sandbox.path("odd.mp4"));
    assert_eq!((found["width"].as_i64(), found["height"].as_i64()), (Some(32), Some(40)));
    assert!(sandbox.names("").iter().all(|name| !name.contains("partial")));
}

/// Returns a folder with this script as `ffmpeg`, for use as the path; the script itself finds the system's tools.
fn with_ffmpeg(script: &str) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_script(&folder.path().join("ffmpeg"), &format!("PATH=/usr/bin:/bin\n{script}"));
    folder
}

/// Asserts that a video can't be written with `path`, for a reason with all of `parts`, and that no file is left.
fn no_film(sandbox: &Sandbox, path: &Path, splat: &str, code: i32, parts: &[&str]) {
    let mut render =
        sandbox.command(&format!("render --splat @{splat} --orbit --frames 9 --out @out/film.mp4"));
    let output = render.env("PATH", path).output().unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), message.lines().count()), (Some(code), 1), "{message}");
    assert_says(&message, parts);
    assert_eq!(sandbox.names("out"), [""; 0], "{message}");
}

#[test]
fn an_mp4_without_an_encoder_is_refused_before_anything_is_read() {
    let sandbox = Sandbox::new();
    fs::create_dir(sandbox.path("out")).unwrap();
    let nothing = tempfile::tempdir().unwrap();
    // Like a folder that may not be entered, a file that may not be executed makes the search of the PATH fail with a lack of permission.
    let denied = tempfile::tempdir().unwrap();
    fs::write(denied.path().join("ffmpeg"), "not executable").unwrap();
    for path in [nothing.path(), denied.path()] {
        let parts = ["film.mp4", "ffmpeg isn't on the PATH", "apt install ffmpeg", ".gif", "PNGs"];
        no_film(&sandbox, path, "no_such_splat.ply", 2, &parts);
    }
    let other = with_ffmpeg("echo ' V....D mpeg4  MPEG-4 part 2'");
    no_film(&sandbox, other.path(), "no_such_splat.ply", 2, &["lacks libx264", ".gif"]);
    // A GIF needs no ffmpeg.
    let mut render =
        sandbox.command("render --splat @room/truth.ply --orbit --frames 2 --size 16x16 --out @film.gif");
    assert!(render.env("PATH", nothing.path()).status().unwrap().success());
}

#[test]
fn an_encoder_that_fails_is_quoted_and_leaves_nothing() {
    const KNOWS: &str =
        "case $* in *-encoders*) echo libx264; exit;; esac; for out; do :; done; echo begun > \"$out\"";
    let sandbox = Sandbox::new();
    fs::create_dir(sandbox.path("out")).unwrap();
    for (script, message) in [
        ("head -c 9 > /dev/null; echo 'the disk is full' >&2; exit 1", "ffmpeg failed: the disk is full"),
        ("cat > /dev/null; echo 'no trailer' >&2; exit 1", "ffmpeg failed: no trailer"),
        ("cat > /dev/null; kill -9 $$", "ffmpeg failed (signal: 9"),
        ("exit 0", "ffmpeg ended early"),
    ] {
        let ffmpeg = with_ffmpeg(&format!("{KNOWS}; {script}"));
        no_film(&sandbox, ffmpeg.path(), "room/truth.ply", 1, &[message]);
    }
}

#[test]
fn ctrl_c_leaves_no_half_film() {
    for ending in ["gif", "mp4"] {
        if ending == "mp4" && !has_ffmpeg() {
            return;
        }
        let sandbox = Sandbox::new();
        fs::create_dir(sandbox.path("out")).unwrap();
        let mut render = sandbox.command(&format!(
            "render --splat @room/truth.ply --orbit --frames 100000 --size 64x64 --out @out/film.{ending}"
        ));
        let mut program = render.stderr(Stdio::piped()).spawn().unwrap();
        // Frames are written as they are rendered. The program has checked earlier, with an empty file, that it may write here.
        let partial = sandbox.path(&format!("out/.film.{ending}.globalsplat-partial"));
        let least = if ending == "gif" { 100_000 } else { 1 };
        let is_written = || fs::metadata(&partial).is_ok_and(|file| file.len() >= least);
        wait_for(std::slice::from_mut(&mut program), || is_written().then_some(()));
        send_signal(program.id(), libc::SIGINT);
        let output = program.wait_with_output().unwrap();
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{message}");
        assert_says(&message, &["stopped after", "of 100000 views"]);
        assert_eq!(sandbox.names("out"), [""; 0]);
    }
}

/// Returns the size of a GIF in pixels, and the delays of its frames in hundredths of a second.
fn delays(film: &Path) -> ((u16, u16), Vec<u16>) {
    let mut decoder = gif::DecodeOptions::new().read_info(fs::File::open(film).unwrap()).unwrap();
    let mut delays = vec![];
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        delays.push(frame.delay);
    }
    ((decoder.width(), decoder.height()), delays)
}

#[test]
fn gifs_have_the_requested_duration() {
    let sandbox = Sandbox::new();
    let render = "render --splat @room/truth.ply --orbit --frames 12 --size 20x16 --alpha";
    sandbox.run(&format!("{render} --fps 24 --out @film.gif"));
    let (size, delays) = delays(&sandbox.path("film.gif"));
    // Half a second in total, although 1/24 s is not a whole number of hundredths.
    assert_eq!((size, delays.len(), delays.iter().sum::<u16>()), ((44, 16), 12, 50), "{delays:?}");
    let message = sandbox.refuse(&format!("{render} --fps 60 --out @film.gif"));
    assert_says(&message, &["frames per second is 60, expected 1 to 50 in a .gif"]);
    let message = sandbox.refuse(&format!("{render} --fps 24 --out @views"));
    assert!(message.contains("--fps is for films") && !sandbox.path("views").exists(), "{message}");
}

#[test]
fn a_smooth_path_goes_from_the_first_camera_to_the_last() {
    let sandbox = Sandbox::new();
    for (out, cameras) in [
        ("views", "--scene @room"),
        ("smooth", "--scene @room --frames 25"),
        ("along", "--path @room --frames 25"),
    ] {
        sandbox.run(&format!("render --splat @room/truth.ply {cameras} --out @{out}"));
    }
    let [views, smooth, along] = ["views", "smooth", "along"].map(|name| sandbox.path(name));
    let (views, path) = (pictures(&views), pictures(&smooth));
    assert_eq!((views.len(), path.len()), (9, 25));
    assert_eq!(path, pictures(&along));
    assert!(psnr(&views[0], &path[0]) > 50. && psnr(&views[8], &path[24]) > 50.);
}

#[test]
fn all_pictures_have_one_scale_of_depth() {
    let sandbox = Sandbox::new();
    // Both cameras have one position, and the second has eight times the focal length. The center has the same depth in both images.
    let mut wide = open_capture(&sandbox.path("room")).unwrap().cameras()[8];
    (wide.intrinsics.cx, wide.intrinsics.cy) = (20., 20.);
    let mut long = wide;
    (long.intrinsics.fx, long.intrinsics.fy) = (8. * wide.intrinsics.fx, 8. * wide.intrinsics.fy);
    write_cameras_json(&sandbox.path("zoom.json"), &[String::new(), String::new()], &[wide, long]).unwrap();
    sandbox.run("render --splat @room/truth.ply --path @zoom.json --depth --size 320x320 --out @views");
    let [_, wide, _, long] = <[_; 4]>::try_from(pictures(&sandbox.path("views"))).unwrap();
    // The center of the one, enlarged, equals the other.
    let middle = image::imageops::crop_imm(&wide, 140, 140, 40, 40).to_image();
    let middle = image::imageops::resize(&middle, 320, 320, image::imageops::FilterType::Triangle);
    let likeness = psnr(&middle, &long);
    println!("{likeness:.1} dB");
    assert!(likeness > 30., "colors of the same depths are {likeness} dB alike");
}

fn assert_same(path: &Path, expected: &[Camera], tolerance: f64) {
    let found = read_camera_path(path, None).unwrap_or_else(|e| panic!("{e}")).cameras;
    assert_eq!(found.len(), expected.len(), "{}", path.display());
    for (a, b) in found.iter().zip(expected) {
        assert_eq!((a.width, a.height), (b.width, b.height));
        let both = a.intrinsics.to_rows().into_iter().zip(b.intrinsics.to_rows());
        both.for_each(|(a, b)| assert!((a - b).abs() < 40. * tolerance, "{}: {a} {b}", path.display()));
        assert!(a.c2w.abs_diff_eq(b.c2w, tolerance), "{}: {} {}", path.display(), a.c2w, b.c2w);
    }
}

#[test]
fn a_path_takes_every_format_and_needs_no_photos() {
    let sandbox = Sandbox::new();
    let cameras = open_capture(&sandbox.path("room")).unwrap().cameras();
    sandbox.run("pack @room --out @chunks");
    assert_same(&sandbox.path("chunks/000000.torch#room"), &cameras, 1e-5);
    for format in [None, Some(Format::Transforms), Some(Format::ColmapText), Some(Format::ColmapBinary)] {
        let sandbox = Sandbox::new();
        let room = sandbox.path("room");
        if let Some(format) = format {
            rewrite(&room, format);
        }
        fs::remove_dir_all(room.join("images")).unwrap();
        assert!(open_capture(&room).is_err(), "the photos are gone");
        assert_same(&room, &cameras, 1e-9);
        // A file of cameras may have any name.
        for file in ["cameras.json", "transforms.json"].map(|name| room.join(name)) {
            if file.exists() {
                assert_same(&file, &cameras, 1e-9);
                fs::rename(&file, sandbox.path("my path.json")).unwrap();
                assert_same(&sandbox.path("my path.json"), &cameras, 1e-9);
                sandbox.run("render --splat @room/truth.ply --path '@my path.json' --out @row.png");
                assert_eq!(image::image_dimensions(sandbox.path("row.png")).unwrap(), (9 * 40 + 8 * 4, 40));
            }
        }
    }
}

#[test]
fn a_path_without_image_sizes_needs_photos_or_size() {
    let sandbox = Sandbox::new();
    let room = sandbox.path("room");
    rewrite(&room, Format::Transforms);
    sandbox.change_json("room/transforms.json", |json| {
        json.as_object_mut().unwrap().retain(|key, _| key != "w" && key != "h");
    });
    let cameras = open_capture(&room).unwrap().cameras();
    assert_same(&room, &cameras, 1e-9);
    fs::remove_dir_all(room.join("images")).unwrap();
    let render = "render --splat @room/truth.ply --path @room --out @row.png";
    assert_says(&sandbox.refuse(render), &["the size of frame 0 is missing", "--size"]);
    let found = read_camera_path(&room, Some([40, 40].into())).unwrap().cameras;
    assert_eq!((found[0].width, found[0].intrinsics), (40, cameras[0].intrinsics));
    sandbox.run(&format!("{render} --size 40x40"));
}

/// Returns a camera path as nerfstudio's viewer writes it.
fn of_viewer(cameras: &[Camera]) -> Value {
    let frames = cameras.iter().map(|camera| {
        let opengl = camera.c2w * DMat4::from_diagonal(DVec4::new(1., -1., -1., 1.));
        let fov = 2. * (f64::from(camera.height) / 2. / camera.intrinsics.fy).atan().to_degrees();
        json!({"camera_to_world": pose_to_rows(&opengl), "fov": fov, "aspect": 1.5})
    });
    json!({
        "camera_type": "perspective", "render_height": cameras[0].height, "render_width": cameras[0].width,
        "camera_path": frames.collect::<Vec<_>>(), "fps": 24, "seconds": 4, "is_cycle": false, "keyframes": [],
    })
}

#[test]
fn a_path_of_nerfstudio_s_viewer_is_flown() {
    let sandbox = Sandbox::new();
    let mut cameras = open_capture(&sandbox.path("room")).unwrap().cameras();
    for camera in &mut cameras {
        // Such a path stores only square pixels and a principal point in the middle.
        camera.width = 60;
        camera.intrinsics.fx = camera.intrinsics.fy;
        (camera.intrinsics.cx, camera.intrinsics.cy) = (30., 20.);
    }
    let file = sandbox.path("2026-01-01.json");
    fs::write(&file, of_viewer(&cameras).to_string()).unwrap();
    assert_same(&file, &cameras, 1e-9);
    assert_eq!(read_camera_path(&file, None).unwrap().frames_per_second, Some(24));
    let render = "render --splat @room/truth.ply --path @2026-01-01.json";
    sandbox.run(&format!("{render} --frames 12 --out @film.gif"));
    assert_eq!(delays(&sandbox.path("film.gif")).1.iter().sum::<u16>(), 50);

    type Change = fn(&mut Value);
    let changes: [(Change, &[&str]); 12] = [
        (|json| json["camera_type"] = json!("fisheye"), &["camera_type is \"fisheye\"", "perspective"]),
        (|json| json["render_height"] = json!(0), &["render_height is 0", "a number of pixels"]),
        (|json| json["render_width"] = json!(20.5), &["render_width is 20.5", "a number of pixels"]),
        (|json| drop(json.as_object_mut().unwrap().remove("render_width")), &["render_width is missing"]),
        (|json| json["camera_path"] = json!([]), &["camera_path is a list of 0", "a list of cameras"]),
        (|json| json["camera_path"] = json!("x"), &["camera_path is \"x\"", "a list of cameras"]),
        (|json| json["camera_path"][3]["fov"] = json!(180), &["fov of camera 3 is 180", "between 0 and 180"]),
        (|json| json["camera_path"][1]["fov"] = Value::Null, &["fov of camera 1 is null", "degrees"]),
        (
            |json| json["camera_path"][2]["camera_to_world"] = json!([1., 0.]),
            &["camera_to_world of camera 2 is a list of 2", "16 numbers"],
        ),
        (
            |json| json["camera_path"][2]["camera_to_world"][0] = json!(3.),
            &["camera_to_world of camera 2 is a matrix that isn't rigid", "a rotation"],
        ),
        (|json| json["fps"] = json!(0), &["fps is 0", "1 to 120"]),
        (|json| json["fps"] = json!("fast"), &["fps is \"fast\"", "1 to 120"]),
    ];
    let refuse =
        |parts: &[&str]| assert_says(&sandbox.refuse(&format!("{render} --out @refused.gif")), parts);
    for (change, parts) in changes {
        let mut json = of_viewer(&cameras);
        change(&mut json);
        fs::write(&file, json.to_string()).unwrap();
        refuse(&[&["2026-01-01.json"], parts].concat());
    }
    assert!(!sandbox.path("refused.gif").exists());
    // These files aren't camera paths.
    for (text, part) in [
        ("{", "not a description of cameras"),
        ("{\"frames\": 3}", "frames is 3"),
        ("{\"frames\": []}", "number of views is 0, expected one or more"),
    ] {
        fs::write(&file, text).unwrap();
        refuse(&[part]);
    }
}
