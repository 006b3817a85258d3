//! Captures up to the first command of COLMAP: requests that are refused, and videos whose frames are chosen once.

use crate::{failing_colmap, has_ffmpeg, make, write_noise};
use globalsplat_colmap::{CaptureOptions, Colmap, Progress, Step, make_capture};
use globalsplat_files::FolderLock;
#[cfg(unix)]
use globalsplat_test_kit::rerun_test;
use serde_json::{Value, json};
use std::fs;
use std::path::Path;
use std::process::Command;

#[test]
fn bad_requests_are_refused_in_one_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    ["empty", "full"].iter().for_each(|name| fs::create_dir(at(name)).unwrap());
    fs::write(at("full/thesis.tex"), "").unwrap();
    write_noise(&at("photos"));
    write_noise(&at("same"));
    write_noise(&at("scan/keyframes/images"));
    fs::create_dir(at("scan/keyframes/cameras")).unwrap();
    for index in 1..4 {
        fs::copy(at("same/0.png"), at(&format!("same/{index}.png"))).unwrap();
    }
    for (source, out, camera_model, expected) in [
        (
            "empty",
            "out",
            None,
            "empty: the folder is without photos, of 0 files, expected photos, each a JPEG",
        ),
        (
            "same",
            "same_out",
            None,
            "same: the number of photos is 4, of which 3 can't be used (1.png is identical to 0.png, 2.png is identical to 0.png, \
             3.png is identical to 0.png), expected 2 or more different ones",
        ),
        (
            "photos",
            "full",
            None,
            "full: the output is a folder with thesis.tex, expected a new folder, or one with such a capture",
        ),
        (
            "photos",
            "photos/out",
            None,
            "photos/out: the output is inside the folder of photos, expected a folder outside of photos",
        ),
        (
            "scan",
            "out",
            None,
            "scan: the folder of photos is raw data of Polycam, which have poses, expected --scene with this folder, or a folder of photos \
             alone",
        ),
        ("photos", "out", Some("FISH"), "the camera model is FISH, expected one of SIMPLE_PINHOLE, "),
    ] {
        let options = CaptureOptions { camera_model: camera_model.map(String::from), ..Default::default() };
        let error = make(&at(source), &at(out), &options, &failing_colmap()).unwrap_err();
        assert!(error.is_invalid_request(), "{error}");
        let error = error.to_string().replace('\\', "/");
        let error = error.replace(&format!("{}/", folder.path().display()).replace('\\', "/"), "");
        assert!(error.starts_with(expected), "{error}");
    }
    assert!(!at("out").exists());
    #[cfg(unix)]
    {
        use std::os::unix::ffi::OsStrExt;
        let latin_1 = folder.path().join(std::ffi::OsStr::from_bytes(b"caf\xe9"));
        let error = make(&at("photos"), &latin_1, &CaptureOptions::default(), &failing_colmap()).unwrap_err();
        assert!(
            error.is_invalid_request() && error.to_string().contains("a path that isn't UTF-8"),
            "{error}"
        );
    }
    let error = Colmap::at(Path::new("/no/such/python3")).unwrap_err();
    assert!(error.is_invalid_request());
    let expected = "/no/such/python3: the program is a Python without pycolmap, expected a colmap program or a Python with pycolmap \
                    (pip install pycolmap, or apt install colmap)";
    assert_eq!(error.to_string(), expected);
}

#[test]
fn frames_of_a_video_are_chosen_once_and_their_poses_estimated() {
    if !has_ffmpeg() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (video, out) = (folder.path().join("walk.mp4"), folder.path().join("out"));
    // 20 frames that pan over a pattern.
    let source = "testsrc2=size=320x160:rate=10:duration=2,crop=200:120:n*5:10";
    let ffmpeg =
        Command::new("ffmpeg").args(["-v", "error", "-f", "lavfi", "-i", source]).arg(&video).status();
    assert!(ffmpeg.unwrap().success());
    let run = |frames: usize| {
        let options = CaptureOptions { frames: Some(frames), ..Default::default() };
        let mut has_measured = false;
        let result = make_capture(&video, &out, &options, &failing_colmap(), &mut |progress| {
            has_measured |= progress.step == Step::Measure;
            true
        });
        (result.unwrap_err().to_string(), has_measured)
    };
    let is_estimated = |error: &str| error.contains("COLMAP's feature_extractor failed");
    let (error, has_measured) = run(6);
    assert!(is_estimated(&error) && has_measured, "{error}");
    assert_eq!(fs::read_dir(out.join("images")).unwrap().count(), 6);
    let (error, has_measured) = run(6);
    assert!(is_estimated(&error) && !has_measured, "{error}");
    assert!(run(5).0.contains("the video is 6 frames of walk.mp4"));
    // A call for another video that was killed while it moved 5 frames. Another program wrote one more.
    let record = out.join("capture.json");
    let mut unfinished: Value = serde_json::from_slice(&fs::read(&record).unwrap()).unwrap();
    (unfinished["video"]["indices"], unfinished["found"]) = (json!([]), json!([]));
    (unfinished["video"]["name"], unfinished["video"]["moving"]) = (json!("other.mp4"), json!(5));
    fs::write(&record, unfinished.to_string()).unwrap();
    fs::remove_file(out.join("images/frame_00005.jpg")).unwrap();
    assert!(run(5).0.contains("the folder of frames is one with frame_00006.jpg"));
    fs::remove_file(out.join("images/frame_00006.jpg")).unwrap();
    let (error, has_measured) = run(5);
    assert!(is_estimated(&error) && has_measured, "{error}");
    assert_eq!(fs::read_dir(out.join("images")).unwrap().count(), 5);
    // Nothing is left of what is refused, and a call that is stopped can be repeated.
    let (bad, other) = (folder.path().join("bad.mp4"), folder.path().join("other"));
    fs::write(&bad, "no video").unwrap();
    assert!(make(&bad, &other, &CaptureOptions::default(), &failing_colmap()).is_err() && !other.exists());
    for step in [Step::Measure, Step::Frames] {
        let mut go_on = |progress: Progress| progress.step != step;
        let stopped = make_capture(&video, &other, &CaptureOptions::default(), &failing_colmap(), &mut go_on);
        assert!(stopped.unwrap().is_none());
    }
    assert!(!other.join("capture.json").exists());
    // Frames that another program wrote.
    fs::remove_file(record).unwrap();
    let frame = fs::read(out.join("images/frame_00001.jpg")).unwrap();
    assert!(run(6).0.contains("the output is a folder with images"));
    assert_eq!(fs::read(out.join("images/frame_00001.jpg")).unwrap(), frame);
}

#[test]
fn a_capture_is_made_by_one_process_at_a_time() {
    let folder = tempfile::tempdir().unwrap();
    let [photos, out] = ["photos", "out"].map(|name| folder.path().join(name));
    write_noise(&photos);
    fs::create_dir(&out).unwrap();
    let mut lock = Some(FolderLock::try_take(&out).unwrap().unwrap());
    let mut steps = vec![];
    let result =
        make_capture(&photos, &out, &CaptureOptions::default(), &failing_colmap(), &mut |progress| {
            // Released when the second one has said that it waits.
            lock = None;
            steps.push(progress.step);
            true
        });
    assert!(result.unwrap_err().to_string().contains("COLMAP's feature_extractor failed"));
    assert_eq!(steps[..2], [Step::Wait, Step::Photos]);
}

/// Modules and environments in the working folder may be anybody's.
#[cfg(unix)]
#[test]
fn nothing_in_the_working_folder_is_run() {
    const NAME: &str = "capture::nothing_in_the_working_folder_is_run";
    const CHILD: &str = "GLOBALSPLAT_TEST_WORKING_FOLDER";
    if let Some(folder) = std::env::var_os(CHILD) {
        std::env::set_current_dir(folder).unwrap();
        // Without COLMAP, only the search for it is tested.
        if let Ok(colmap) = Colmap::find() {
            let _ = make(Path::new("photos"), Path::new("out"), &CaptureOptions::default(), &colmap);
        }
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    write_noise(&folder.path().join("photos"));
    let trap = format!("open({:?}, 'w')", folder.path().join("was_run"));
    let write = |name: &str, contents: &str| {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, contents).unwrap();
        path
    };
    for module in ["json.py", "site.py", "pycolmap.py", "lib/sitecustomize.py"] {
        write(module, &trap);
    }
    for version in 8..20 {
        write(&format!("lib/python3.{version}/site-packages/pycolmap.py"), &trap);
    }
    for python in [".venv/bin/python", "bin/python"] {
        let python = write(python, &format!("#!/bin/sh\ntouch {}/was_run\n", folder.path().display()));
        fs::set_permissions(python, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
    }
    let (library, empty) = (folder.path().join("lib"), Path::new(""));
    let variables = [
        (CHILD, folder.path()),
        ("PYTHONPATH", &library),
        ("PYTHONUSERBASE", folder.path()),
        ("VIRTUAL_ENV", empty),
        ("CONDA_PREFIX", empty),
    ];
    assert!(rerun_test(NAME, &variables).0);
    assert!(!folder.path().join("was_run").exists());
}
