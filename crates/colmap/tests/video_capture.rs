//! Captures of videos, up to the first command of COLMAP.
#![cfg(unix)]

use globalsplat_colmap::{CaptureOptions, CaptureProgress, Colmap, VideoOptions, make_capture};
use globalsplat_test_kit::skip;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

/// Writes a video of 20 frames that pans over a pattern. Returns `false` if there is no ffmpeg.
fn write_video(path: &Path) -> bool {
    let source = "testsrc2=size=320x160:rate=10:duration=2,crop=200:120:n*5:10";
    let run = Command::new("ffmpeg").args(["-v", "error", "-f", "lavfi", "-i", source]).arg(path).status();
    run.is_ok_and(|status| status.success())
}

/// Returns a COLMAP whose commands all fail.
fn failing_colmap(folder: &Path) -> Colmap {
    let program = folder.join("colmap");
    let script =
        "#!/bin/sh\nif [ $1 = help ]; then echo 'COLMAP 3.9 -- Structure-from-Motion'; else exit 1; fi\n";
    std::fs::write(&program, script).unwrap();
    std::fs::set_permissions(&program, PermissionsExt::from_mode(0o755)).unwrap();
    Colmap::at(&program).unwrap()
}

#[test]
fn frames_of_a_video_are_chosen_once_and_their_poses_estimated() {
    let folder = tempfile::tempdir().unwrap();
    let (video, out) = (folder.path().join("walk.mp4"), folder.path().join("out"));
    if !write_video(&video) {
        return skip("ffmpeg", "a video can't be written");
    }
    let colmap = failing_colmap(folder.path());
    let run = |frames: usize| {
        let options = CaptureOptions { video: VideoOptions { frames: Some(frames) }, ..Default::default() };
        let mut passes = 0;
        let result = make_capture(&video, &out, &options, &colmap, |progress| {
            passes += usize::from(matches!(progress, CaptureProgress::Video(_)));
            true
        });
        (result.unwrap_err().to_string(), passes > 0)
    };
    let (error, has_measured) = run(6);
    assert!(error.contains("COLMAP's feature_extractor failed") && has_measured, "{error}");
    assert_eq!(std::fs::read_dir(out.join("images")).unwrap().count(), 6);
    let (error, has_measured) = run(6);
    assert!(error.contains("COLMAP's feature_extractor failed") && !has_measured, "{error}");
    let (error, _) = run(5);
    assert!(error.contains("the video is 6 frames of walk.mp4"), "{error}");
    // A call that was killed leaves the frames without the record.
    std::fs::remove_dir_all(&out).unwrap();
    std::fs::create_dir_all(out.join("images")).unwrap();
    std::fs::write(out.join("images/frame_00001.jpg"), "").unwrap();
    let (error, has_measured) = run(6);
    assert!(error.contains("COLMAP's feature_extractor failed") && has_measured, "{error}");
}
