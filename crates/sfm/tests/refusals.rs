//! Requests that are refused before COLMAP is started. The only test of its process writes a program: while another test started a process,
//! it couldn't be run ("text file busy").

#![cfg(unix)]

use globalsplat_sfm::{Colmap, PoseOptions, estimate_poses};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

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
        assert!(error.is_request(), "{error}");
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
}
