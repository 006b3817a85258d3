//! Poses that COLMAP finds for the photos of a synthetic scene, whose poses are known.

use glam::DMat4;
use globalsplat_capture::{Camera, Lens, open_capture};
use globalsplat_colmap::{Colmap, Matching, PoseOptions, PoseReport, Step, estimate_poses};
use globalsplat_synth::{Video, VideoSettings};
use globalsplat_test_kit::{pose_errors, skip};
use image::RgbImage;
use std::collections::BTreeSet;
use std::path::Path;

mod noise;

/// Returns COLMAP, or skips the test.
fn find_colmap() -> Option<Colmap> {
    Colmap::find().map_err(|why| skip("pycolmap", &why.to_string())).ok()
}

/// Writes photos of a synthetic scene to `folder`, and returns their cameras.
fn write_photos(folder: &Path) -> Vec<Camera> {
    let settings = VideoSettings { frames: 10, size: [360, 480].into(), pictures: vec![] };
    let video = Video::new(1, 3, &settings);
    std::fs::create_dir_all(folder).unwrap();
    for index in 0..settings.frames {
        video.photo(index).save(folder.join(format!("{index:02}.png"))).unwrap();
    }
    video.cameras().to_vec()
}

/// Estimates the poses without stopping.
fn estimate(
    photos: &Path,
    out: &Path,
    options: &PoseOptions,
    colmap: &Colmap,
) -> (PoseReport, BTreeSet<Step>) {
    let mut steps = BTreeSet::new();
    let report = estimate_poses(photos, out, options, colmap, &mut |progress| {
        assert!(progress.done <= progress.total, "{progress:?}");
        steps.insert(progress.step);
        true
    });
    (report.unwrap().expect("nothing stops it"), steps)
}

#[test]
fn poses_are_those_of_the_scene_and_a_stopped_estimate_continues() {
    let Some(colmap) = find_colmap() else { return };
    let folder = tempfile::tempdir().unwrap();
    let (photos, out) = (folder.path().join("photos"), folder.path().join("out"));
    let truth: Vec<DMat4> = write_photos(&photos).iter().map(|camera| camera.c2w).collect();
    std::fs::copy(photos.join("00.png"), photos.join("copy.png")).unwrap();
    let whole = std::fs::read(photos.join("00.png")).unwrap();
    std::fs::write(photos.join("damaged.png"), &whole[..whole.len() / 2]).unwrap();
    std::fs::write(photos.join("text.png"), b"no photo").unwrap();
    let options = PoseOptions::default();

    // Stopped among the features, then after them.
    let stop_at = |step: Step, done: usize| {
        let report = estimate_poses(&photos, &out, &options, &colmap, &mut |progress| {
            progress.step < step || progress.step == step && progress.done < done
        });
        assert!(report.unwrap().is_none());
    };
    stop_at(Step::Features, 4);
    stop_at(Step::Pairs, 0);
    let (report, steps) = estimate(&photos, &out, &options, &colmap);
    assert_eq!(steps, [Step::Pairs, Step::Poses].into(), "features are detected once");
    assert_eq!((report.photos, report.registered, report.unregistered.len()), (12, 10, 0), "{report}");
    let skipped: Vec<&str> = report.skipped.iter().map(|photo| photo.name.as_str()).collect();
    assert_eq!(skipped, ["copy.png", "damaged.png"]);
    assert!(report.other_files.as_ref().is_some_and(|line| line.ends_with("left out: text.png")), "{report}");
    assert!(report.points > 500 && report.reprojection_error < 1., "{report}");

    let capture = open_capture(&out).unwrap();
    let names: Vec<&str> = capture.names().collect();
    assert_eq!((names.len(), names[0], names[9]), (10, "00.png", "09.png"));
    let cameras = capture.cameras();
    // All photos have one camera, though the first ones were read before the estimate was stopped.
    assert!(cameras.iter().all(|camera| camera.intrinsics == cameras[0].intrinsics));
    let found: Vec<DMat4> = cameras.iter().map(|camera| camera.c2w).collect();
    let errors = pose_errors(&found, &truth);
    assert!(errors.iter().all(|&(position, angle)| position < 0.005 && angle < 0.3), "{errors:?}");

    // A finished estimate is reported again, and other pairs leave the features.
    let (again, steps) = estimate(&photos, &out, &options, &colmap);
    assert!(steps.is_empty() && again.points == report.points);
    let sequential = PoseOptions { matching: Matching::Sequential, ..options };
    let (again, steps) = estimate(&photos, &out, &sequential, &colmap);
    assert_eq!((again.registered, steps), (10, [Step::Pairs, Step::Poses].into()));

    // Other photos don't replace a capture.
    std::fs::remove_file(photos.join("05.png")).unwrap();
    let error = estimate_poses(&photos, &out, &sequential, &colmap, &mut |_| true).unwrap_err();
    assert!(error.is_invalid_request() && error.to_string().contains("other or changed photos"), "{error}");
}

#[test]
fn fisheyes_without_a_known_focal_length_are_placed() {
    let Some(colmap) = find_colmap() else { return };
    let folder = tempfile::tempdir().unwrap();
    let (photos, out) = (folder.path().join("photos"), folder.path().join("out"));
    std::fs::create_dir(&photos).unwrap();
    let settings = VideoSettings { frames: 8, size: [300, 400].into(), pictures: vec![] };
    let video = Video::new(1, 3, &settings);
    let lens = Lens::from_colmap("SIMPLE_FISHEYE", &[180., 200., 150.], settings.size).unwrap();
    for index in 0..settings.frames {
        video.photo_through(index, &lens).save(photos.join(format!("{index}.png"))).unwrap();
    }
    let options = PoseOptions { camera_model: Some("SIMPLE_FISHEYE".into()), ..Default::default() };
    let (report, _) = estimate(&photos, &out, &options, &colmap);
    assert_eq!((report.registered, report.unregistered.len()), (8, 0), "{report}");
}

#[test]
fn masked_pixels_have_no_features() {
    let Some(colmap) = find_colmap() else { return };
    let folder = tempfile::tempdir().unwrap();
    let [photos, masks, out] = ["photos", "masks", "out"].map(|name| folder.path().join(name));
    let count = write_photos(&photos).len();
    std::fs::create_dir(&masks).unwrap();
    for index in 0..count {
        RgbImage::new(480, 360).save(masks.join(format!("{index:02}.png"))).unwrap();
    }
    let options = PoseOptions { masks: Some(masks), ..Default::default() };
    let error = estimate_poses(&photos, &out, &options, &colmap, &mut |_| true).unwrap_err().to_string();
    assert!(error.starts_with("COLMAP registered none of the 10 photos: "), "{error}");
}

#[test]
fn photos_that_share_nothing_are_an_error() {
    let Some(colmap) = find_colmap() else { return };
    let folder = tempfile::tempdir().unwrap();
    let (photos, out) = (folder.path().join("photos"), folder.path().join("out"));
    noise::write_noise(&photos);
    for count in [4, 2] {
        let options = PoseOptions::default();
        let error = estimate_poses(&photos, &out, &options, &colmap, &mut |_| true).unwrap_err();
        assert!(!error.is_invalid_request(), "{error}");
        let error = error.to_string();
        assert!(error.starts_with(&format!("COLMAP registered none of the {count} photos: ")), "{error}");
        assert_eq!(error.lines().count(), 1);
        std::fs::remove_dir_all(&out).unwrap();
        (2..count).for_each(|index| std::fs::remove_file(photos.join(format!("{index}.png"))).unwrap());
    }
}
