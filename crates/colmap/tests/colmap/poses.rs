//! Poses that COLMAP finds for the photos of a synthetic scene, whose poses are known.

use crate::{make, write_noise};
use glam::{DMat3, DMat4, DVec3, DVec4};
use globalsplat_capture::{Lens, open_capture, read_points};
use globalsplat_colmap::{CaptureOptions, CaptureReport, Colmap, Matching, Step, make_capture};
use globalsplat_synth::{Video, VideoSettings};
use globalsplat_test_kit::{pose_errors, skip};
use image::RgbImage;
use std::collections::BTreeSet;
use std::fs;
use std::path::PathBuf;
use tempfile::TempDir;

/// A temporary folder with the folders `photos` and `out`, and the installed COLMAP.
struct Fixture {
    root: TempDir,
    photos: PathBuf,
    out: PathBuf,
    colmap: Colmap,
}

impl Fixture {
    /// Returns `None` and skips the test without COLMAP.
    fn new() -> Option<Self> {
        let colmap = Colmap::find().map_err(|why| skip("pycolmap", &why.to_string())).ok()?;
        let root = tempfile::tempdir().unwrap();
        let [photos, out] = ["photos", "out"].map(|name| root.path().join(name));
        fs::create_dir(&photos).unwrap();
        Some(Fixture { root, photos, out, colmap })
    }

    /// Writes photos of a synthetic scene, through `lens` or without distortion, and returns the poses of their cameras.
    fn write_photos(&self, count: usize, lens: Option<&Lens>) -> Vec<DMat4> {
        // A scene with enough texture.
        let settings =
            VideoSettings { frames: count, off_path: 0, is_object: false, size: [360, 480].into() };
        let video = Video::new(1, 11, &settings);
        for index in 0..count {
            let photo = match lens {
                Some(lens) => video.photo_through(index, lens),
                None => video.photo(index),
            };
            photo.save(self.photos.join(format!("{index:02}.png"))).unwrap();
        }
        video.cameras().iter().map(|camera| camera.c2w).collect()
    }

    fn make(&self, options: &CaptureOptions) -> globalsplat_colmap::Result<CaptureReport> {
        make(&self.photos, &self.out, options, &self.colmap)
    }

    /// Makes a capture, and returns the steps that it took.
    fn make_steps(&self, options: &CaptureOptions) -> (CaptureReport, BTreeSet<Step>) {
        let mut steps = BTreeSet::new();
        let report = make_capture(&self.photos, &self.out, options, &self.colmap, &mut |progress| {
            assert!(progress.done <= progress.total, "{progress:?}");
            steps.insert(progress.step);
            true
        });
        (report.unwrap().expect("nothing stops it"), steps)
    }
}

#[test]
fn poses_are_those_of_the_scene_and_a_stopped_estimate_continues() {
    let Some(fixture) = Fixture::new() else { return };
    let Fixture { photos, out, colmap, .. } = &fixture;
    let truth = fixture.write_photos(10, None);
    fs::copy(photos.join("00.png"), photos.join("copy.png")).unwrap();
    fs::write(photos.join("text.png"), b"no photo").unwrap();
    let options = CaptureOptions::default();

    // Stopped among the features, then after them.
    for (step, done) in [(Step::Features, 4), (Step::Pairs, 0)] {
        let report = make_capture(photos, out, &options, colmap, &mut |progress| {
            progress.step < step || progress.step == step && progress.done < done
        });
        assert!(report.unwrap().is_none());
    }
    let (report, steps) = fixture.make_steps(&options);
    assert_eq!(steps, [Step::Pairs, Step::Poses].into(), "features are detected once");
    assert_eq!((report.photos, report.registered, report.unregistered.len()), (11, 10, 0), "{report}");
    assert!(matches!(&report.skipped[..], [photo] if photo.name == "copy.png"), "{report}");
    assert!(report.other_files.as_ref().is_some_and(|line| line.ends_with("left out: text.png")), "{report}");
    assert!(report.points > 500 && report.reprojection_error < 1., "{report}");

    let capture = open_capture(out).unwrap();
    let names: Vec<&str> = capture.names().collect();
    assert_eq!((names.len(), names[0], names[9]), (10, "00.png", "09.png"));
    let cameras = capture.cameras();
    // All photos have one camera, though the first ones were read before the estimate was stopped.
    assert!(cameras.iter().all(|camera| camera.intrinsics == cameras[0].intrinsics));
    let found: Vec<DMat4> = cameras.iter().map(|camera| camera.c2w).collect();
    let errors = pose_errors(&found, &truth);
    assert!(errors.iter().all(|&(position, angle)| position < 0.005 && angle < 0.3), "{errors:?}");

    // A finished estimate is reported again, and other pairs leave the features.
    let (again, steps) = fixture.make_steps(&options);
    assert!(steps.is_empty() && again.points == report.points);
    let sequential = CaptureOptions { matching: Matching::Sequential, ..options };
    let (again, steps) = fixture.make_steps(&sequential);
    assert_eq!((again.registered, steps), (10, [Step::Pairs, Step::Poses].into()));

    // Other photos don't replace a capture.
    fs::remove_file(photos.join("05.png")).unwrap();
    let error = fixture.make(&sequential).unwrap_err();
    assert!(error.is_invalid_request() && error.to_string().contains("other or changed photos"), "{error}");
}

/// Of a synthetic scene, which is in metres with y up, positions are known.
#[test]
fn captures_are_upright_and_in_metres_if_positions_are_known() {
    let Some(fixture) = Fixture::new() else { return };
    let truth = fixture.write_photos(12, None);
    let mut options = CaptureOptions::default();
    let compare = |report: &CaptureReport| {
        // The angle in degrees between the scene's up direction and the capture's, and the length of a metre in the capture.
        let cameras = open_capture(&fixture.out).unwrap().cameras();
        let turn = DMat3::from_mat4(cameras[0].c2w) * DMat3::from_mat4(truth[0]).transpose();
        let length = |a: &DMat4, b: &DMat4| a.w_axis.distance(b.w_axis);
        let scale = length(&cameras[0].c2w, &cameras[11].c2w) / length(&truth[0], &truth[11]);
        let photos = report.transform.map(|upright| upright.positions.map(|fit| fit.inliers));
        ((turn * DVec3::Y).angle_between(DVec3::NEG_Y).to_degrees(), scale, photos)
    };
    let report = fixture.make(&options).unwrap();
    let (angle, scale, photos) = compare(&report);
    assert!(angle < 2. && photos == Some(None), "{angle}° {report}");
    assert!(!report.transform.unwrap().is_metric && (scale - 1.).abs() > 0.01, "{scale} {report}");
    let upright = open_capture(&fixture.out).unwrap();
    assert_eq!(upright.upright(), report.transform);
    // The points move along with the cameras.
    let floor = read_points(&upright).unwrap().iter().filter(|point| point.position.y.abs() < 0.1).count();
    assert!(!report.transform.unwrap().has_floor || floor > report.points / 20, "{floor} {report}");

    // COLMAP's own coordinates are those before the transform.
    options.keeps_coordinates = true;
    let (report, steps) = fixture.make_steps(&options);
    assert!(report.transform.is_none() && steps == [Step::Poses].into(), "{steps:?} {report}");
    assert_eq!(open_capture(&fixture.out).unwrap().upright(), None);
    // A finished capture is kept only if it isn't what the user doesn't want.
    options.keeps_finished = true;
    assert!(fixture.make_steps(&options).1.is_empty());
    options.keeps_coordinates = false;
    assert!(fixture.make_steps(&options).1.is_empty());
    options.keeps_finished = false;

    // In UTM, whose unit is 0.9996 m here. One position is wrong.
    let line = |(index, pose): (usize, &DMat4)| {
        let place = pose.w_axis + if index == 5 { DVec4::X * 9. } else { DVec4::ZERO };
        format!("{index:02}.png {} {} {}\n", 5e5 + place.x, 5.3e6 - place.z, 100. + place.y)
    };
    let lines: String = truth.iter().enumerate().map(line).collect();
    fs::write(fixture.photos.join("geo.txt"), format!("EPSG:32632\n{lines}")).unwrap();
    let (report, steps) = fixture.make_steps(&options);
    let (angle, scale, photos) = compare(&report);
    assert!(report.transform.unwrap().is_metric && steps == [Step::Poses].into(), "{steps:?} {report}");
    // The wrong one is left out, and of the others at most those farthest off, which differ between COLMAP's runs.
    assert!(photos.flatten().is_some_and(|count| (9..=11).contains(&count)), "{photos:?}");
    assert!((scale * 0.9996 - 1.).abs() < 0.01 && angle < 2., "{scale} {angle}°");
    let text = report.to_string();
    assert!(text.contains("; in metres by the positions of "), "{text}");
    assert!(text.contains(" of 12 photos (error 0."), "{text}");
    assert!(report.other_files.is_none(), "{text}");

    fs::write(fixture.photos.join("geo.txt"), "EPSG:4326\nother.png 7 48\n").unwrap();
    let error = fixture.make(&options).unwrap_err();
    assert!(
        error.is_invalid_request() && error.to_string().contains("geo.txt: the list of photos"),
        "{error}"
    );
}

#[test]
fn fisheyes_without_a_known_focal_length_are_placed() {
    let Some(fixture) = Fixture::new() else { return };
    let lens = Lens::from_colmap("SIMPLE_FISHEYE", &[200., 240., 180.], [360, 480].into()).unwrap();
    fixture.write_photos(8, Some(&lens));
    let options = CaptureOptions { camera_model: Some("SIMPLE_FISHEYE".into()), ..Default::default() };
    let report = fixture.make(&options).unwrap();
    assert_eq!((report.registered, report.unregistered.len()), (8, 0), "{report}");
}

#[test]
fn photos_that_share_nothing_or_are_masked_are_an_error() {
    let Some(fixture) = Fixture::new() else { return };
    let assert_none_registered = |count: usize, masks: Option<PathBuf>| {
        let error = fixture.make(&CaptureOptions { masks, ..Default::default() }).unwrap_err();
        assert!(!error.is_invalid_request(), "{error}");
        let error = error.to_string();
        assert!(error.starts_with(&format!("COLMAP registered none of the {count} photos: ")), "{error}");
        assert_eq!(error.lines().count(), 1);
        fs::remove_dir_all(&fixture.out).unwrap();
    };
    write_noise(&fixture.photos);
    assert_none_registered(4, None);
    [2, 3].iter().for_each(|index| fs::remove_file(fixture.photos.join(format!("{index}.png"))).unwrap());
    assert_none_registered(2, None);

    fs::remove_dir_all(&fixture.photos).unwrap();
    let masks = fixture.root.path().join("masks");
    [&fixture.photos, &masks].iter().for_each(|folder| fs::create_dir(folder).unwrap());
    fixture.write_photos(10, None);
    (0..10).for_each(|index| RgbImage::new(480, 360).save(masks.join(format!("{index:02}.png"))).unwrap());
    assert_none_registered(10, Some(masks));
}
