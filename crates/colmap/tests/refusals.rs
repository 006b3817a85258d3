//! Requests that are refused before COLMAP is started. The only test of its process writes a program: while another test started a process,
//! it couldn't be run ("text file busy").

#![cfg(unix)]

use globalsplat_colmap::{CaptureOptions, Colmap, PoseOptions, estimate_poses, make_capture};
use globalsplat_test_kit::skip;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

mod noise;

use noise::write_noise;

/// Returns a COLMAP for calls that fail before they start it.
fn stand_in(folder: &Path) -> Colmap {
    let program = folder.join("colmap");
    std::fs::write(&program, "#!/bin/sh\necho 'COLMAP 3.9 -- Structure-from-Motion'\n").unwrap();
    std::fs::set_permissions(&program, PermissionsExt::from_mode(0o755)).unwrap();
    Colmap::at(&program).unwrap()
}

#[test]
fn bad_requests_are_refused_in_one_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let colmap = stand_in(folder.path());
    let at = |name: &str| folder.path().join(name);
    let refusal = |photos: &str, out: &str, options: PoseOptions| {
        let error = estimate_poses(&at(photos), &at(out), &options, &colmap, &mut |_| true).unwrap_err();
        assert!(error.is_invalid_request(), "{error}");
        error.to_string().replace(&format!("{}/", folder.path().display()), "")
    };
    let plain = PoseOptions::default;
    std::fs::create_dir_all(at("empty")).unwrap();
    assert_eq!(
        refusal("empty", "out", plain()),
        "empty: the folder is without photos, of 0 files, expected photos, each a JPEG, PNG, WebP, TIFF, BMP, HEIC or AVIF"
    );
    write_noise(&at("same"));
    for index in 1..4 {
        std::fs::copy(at("same/0.png"), at(&format!("same/{index}.png"))).unwrap();
    }
    assert_eq!(
        refusal("same", "out", plain()),
        "same: the number of photos is 4, of which 3 can't be used (1.png is identical to 0.png, 2.png is identical to 0.png, 3.png is \
         identical to 0.png), expected 2 or more different ones"
    );
    write_noise(&at("photos"));
    std::fs::create_dir_all(at("full")).unwrap();
    std::fs::write(at("full/thesis.tex"), "").unwrap();
    assert_eq!(
        refusal("photos", "full", plain()),
        "full: the output is a folder with thesis.tex, expected a new folder, or one with such a capture"
    );
    assert_eq!(
        refusal("photos", "photos/out", plain()),
        "photos/out: the output is inside the folder of photos, expected a folder outside of photos"
    );
    let unknown = PoseOptions { camera_model: Some("FISH".into()), ..plain() };
    let refused = refusal("photos", "out", unknown);
    assert!(refused.starts_with("the camera model is FISH, expected one of SIMPLE_PINHOLE, "), "{refused}");

    // Photos taken with the lens cap on.
    std::fs::create_dir(at("black")).unwrap();
    for side in [40, 50] {
        image::RgbImage::new(side, side).save(at(&format!("black/{side}.png"))).unwrap();
    }
    let capture_refusal = |source: &str| {
        let options = CaptureOptions::default();
        let error = make_capture(&at(source), &at("new"), &options, &colmap, |_| true).unwrap_err();
        assert!(error.is_invalid_request(), "{error}");
        error.to_string().replace(&format!("{}/", folder.path().display()), "")
    };
    assert_eq!(
        capture_refusal("black"),
        "black: the number of photos is 2, of which 2 can't be used (40.png is of a single color, 50.png is of a single color), expected \
         2 or more different ones"
    );
    std::fs::remove_dir_all(at("new")).unwrap();

    let ffmpeg = |arguments: &[&str]| {
        Command::new("ffmpeg")
            .args(["-v", "error", "-f", "lavfi", "-i"])
            .args(arguments)
            .current_dir(&folder)
            .status()
    };
    if let Err(why) = ffmpeg(&["sine=duration=1", "sound.wav"]) {
        return skip("ffmpeg", &why.to_string());
    }
    assert!(ffmpeg(&["testsrc=size=64x48", "-frames:v", "1", "-c:v", "mjpeg", "one.mkv"]).unwrap().success());
    std::fs::write(at("notes.mp4"), "notes of a walk\n".repeat(200)).unwrap();
    for (source, expected) in [
        ("sound.wav", "sound.wav: the content is sound without pictures, expected a video"),
        ("one.mkv", "one.mkv: the number of frames is 1, expected 2 or more"),
        ("notes.mp4", "notes.mp4: "),
    ] {
        let refused = capture_refusal(source);
        assert!(refused.starts_with(expected) && refused.lines().count() == 1, "{refused}");
        assert!(!at("new").exists(), "{source}");
    }
}
