//! Videos of synthetic scenes are reproducible, consistent with their cameras, and usable like any other data.

use crate::common::program::{Sandbox, arg, assert_says, command, run_process, succeed, tiny_config};
use glam::{DMat3, DMat4, DVec3};
use globalsplat::data::{Dataset, Holdout, Split, SyntheticDataset, load_all_views, open_capture};
use globalsplat::scene::{Camera, ImageSize};
use globalsplat::synth::{Video, VideoSettings};
use npyz::NpyFile;
use std::fs::File;
use std::path::Path;

fn settings(frames: usize, side: u32) -> VideoSettings {
    VideoSettings { frames, off_path: 0, is_object: false, size: ImageSize { height: side, width: side } }
}

/// A seed determines the bytes, whatever the number of threads; another seed gives others.
#[test]
fn a_seed_makes_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = |name: &str, threads: &str, seed: &str| {
        let out = folder.path().join(name);
        let mut synth = command(&["synth", "--scenes", "3", "--frames", "3", "--size", "24", "--seed", seed]);
        run_process(synth.args(["--out", arg(&out)]).env("RAYON_NUM_THREADS", threads));
        std::fs::read(out.join("000000.torch")).unwrap()
    };
    let one = bytes("one", "1", "5");
    assert!(one == bytes("three", "3", "5"), "threads change the bytes");
    assert!(one != bytes("other", "1", "6"), "another seed is another world");
}

#[test]
fn interrupted_synth_is_repeated_and_other_chunks_stay() {
    let sandbox = Sandbox::empty();
    let synth = |seed: u64| {
        format!(
            "synth --scenes 2 --frames 3 --size 24 --depth --contact-sheet @sheet.png --out @worlds --seed {seed}"
        )
    };
    sandbox.run(&synth(0));
    let before = sandbox.contents();
    // Simulates a process that was stopped before it wrote the index.
    for lost in
        ["worlds/index.json", "worlds/evaluation_index.json", "worlds/depth/0_000001.npy", "sheet.png"]
    {
        std::fs::remove_file(sandbox.path(lost)).unwrap();
    }
    sandbox.run(&synth(0));
    assert!(sandbox.contents() == before);
    std::fs::remove_file(sandbox.path("worlds/index.json")).unwrap();
    for (other, found) in [
        (synth(1), "000000.torch: the output is an existing chunk"),
        (synth(0).replace("--size 24", "--size 25"), ".npy: the output is existing depths"),
    ] {
        assert_says(&sandbox.refuse(&other), &[found]);
        let kept = |name: &str| sandbox.read(name) == before[&sandbox.path(name)];
        assert!(kept("worlds/000000.torch") && kept("worlds/depth/0_000000.npy"), "lost");
    }
}

/// Projects a pixel of `from` at `depth` metres into `to`; returns its position in pixels, and its depth there.
fn seen(from: &Camera, to: &Camera, x: f64, y: f64, depth: f64) -> (f64, f64, f64) {
    let k = from.intrinsics;
    let point = from.c2w.transform_point3(depth * DVec3::new((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.));
    let there = to.c2w.inverse().transform_point3(point);
    let k = to.intrinsics;
    (k.fx * there.x / there.z + k.cx, k.fy * there.y / there.z + k.cy, there.z)
}

/// A view warped into another by its depths and both poses agrees with it, where both see the same.
#[test]
fn depths_and_poses_carry_one_view_into_the_next() {
    const SIDE: u32 = 96;
    let mut compared = 0;
    for index in 0..6 {
        let video = Video::new(3, index, &settings(24, SIDE));
        // Near enough that little of what one view sees is occluded in the other.
        let frames = [6, 12];
        let [from, to] = frames.map(|i| &video.cameras()[i]);
        let (photos, depths) = (frames.map(|i| video.photo(i)), frames.map(|i| video.depth(i)));
        let (mut differences, mut unmoved, mut apart) = (vec![], vec![], vec![]);
        for (i, &depth) in depths[0].iter().enumerate().filter(|(_, depth)| depth.is_finite()) {
            let (column, row) = (i as u32 % SIDE, i as u32 / SIDE);
            let (x, y, far) = seen(from, to, f64::from(column) + 0.5, f64::from(row) + 0.5, f64::from(depth));
            if !(0. ..f64::from(SIDE)).contains(&x) || !(0. ..f64::from(SIDE)).contains(&y) || far <= 0. {
                continue;
            }
            let there = (y as u32 * SIDE + x as u32) as usize;
            let difference = (f64::from(depths[1][there]) / far - 1.).abs();
            apart.push(difference);
            // A different depth: the point is occluded.
            if difference > 0.05 {
                continue;
            }
            let difference = |a: [u8; 3], b: [u8; 3]| {
                a.iter().zip(b).map(|(&a, b)| (i32::from(a) - i32::from(b)).abs()).max().unwrap()
            };
            let here = photos[0].get_pixel(column, row).0;
            differences.push(difference(here, photos[1].get_pixel(x as u32, y as u32).0));
            unmoved.push(difference(here, photos[1].get_pixel(column, row).0));
        }
        if apart.len() < 1000 {
            continue;
        }
        compared += 1;
        apart.sort_by(f64::total_cmp);
        let (half, most) = (apart[apart.len() / 2], apart[apart.len() * 7 / 10]);
        assert!(half < 0.008 && most < 0.02, "video {index}: depths are {half} apart for half of the pixels");
        let mean = |of: &[i32]| of.iter().map(|&x| f64::from(x)).sum::<f64>() / of.len() as f64;
        let (moved, unmoved) = (mean(&differences), mean(&unmoved));
        let message = format!("video {index}: {moved} of 255 apart, {unmoved} if not carried");
        assert!(moved < 30. && moved < 0.6 * unmoved, "{message}");
    }
    assert!(compared >= 4, "{compared} videos");
}

#[test]
fn cameras_are_in_free_space_and_move() {
    for index in 0..8 {
        let video = Video::new(2, index, &settings(12, 16));
        let near = video.depth(6).into_iter().fold(f32::INFINITY, f32::min);
        assert!(near > 0.02, "video {index}: something {near} m before the camera");
        let centers = [0, 11].map(|i| video.cameras()[i].c2w.w_axis.truncate());
        assert!(centers[0].distance(centers[1]) > 0.01, "video {index} doesn't move");
        assert!(centers[0].distance(centers[1]) < 12., "video {index} leaves");
    }
}

/// Some videos go around an object, as people photograph objects: all cameras look at nearly the same point, by more than 45
/// degrees from one another.
#[test]
fn some_videos_orbit_an_object() {
    let is_around = |index| {
        let cameras = Video::new(5, index, &settings(5, 16)).cameras().to_vec();
        let rays: Vec<(DVec3, DVec3)> =
            cameras.iter().map(|c| (c.c2w.w_axis.truncate(), c.c2w.z_axis.truncate())).collect();
        let turn = rays.iter().map(|ray| ray.1.angle_between(rays[0].1)).fold(0., f64::max);
        // The point that is nearest to all rays from c along d solves Σ (I − d dᵀ) p = Σ (I − d dᵀ) c.
        let across = |d: DVec3| DMat3::IDENTITY - DMat3::from_cols(d.x * d, d.y * d, d.z * d);
        let sum = rays.iter().fold(DMat3::ZERO, |sum, &(_, d)| sum + across(d));
        let point = sum.inverse() * rays.iter().map(|&(c, d)| across(d) * c).sum::<DVec3>();
        let near = |&(c, d): &(DVec3, DVec3)| {
            let (away, past) = (point - c, across(d) * (point - c));
            away.dot(d) > 0. && past.length() < 0.15 * away.length()
        };
        turn > 0.8 && rays.iter().all(near)
    };
    let around = (0..16).filter(|&index| is_around(index)).count();
    assert!((2..=9).contains(&around), "{around} of 16 videos");
}

/// Written videos are a dataset, with an evaluation index; videos generated on the fly have the same scenes.
#[test]
fn videos_are_data_like_any_other() {
    let folder = tempfile::tempdir().unwrap();
    let (out, sheet) = (folder.path().join("worlds"), folder.path().join("sheet.png"));
    let scenes = ["--scenes", "2", "--first", "7", "--seed", "3", "--frames", "9", "--size", "24", "--depth"];
    succeed(&[&["synth", "--out", arg(&out), "--contact-sheet", arg(&sheet)][..], &scenes].concat());
    assert!(image::open(&sheet).unwrap().width() > 8 * 24);
    let depths = NpyFile::new(File::open(out.join("depth/3_000008.npy")).unwrap()).unwrap();
    assert_eq!(depths.shape(), [9, 24, 24]);
    let video = Video::new(3, 8, &settings(9, 24));
    let expected: Vec<f32> = (0..9).flat_map(|view| video.depth(view)).collect();
    assert_eq!(depths.into_vec::<f32>().unwrap(), expected);
    let report = succeed(&["inspect", arg(&out), "--json"]);
    assert!(report.contains(r#""chunks":1,"kind":"data set","scenes":2"#), "{report}");
    let weights = folder.path().join("weights.safetensors");
    succeed(&["export", "--config", arg(&tiny_config(folder.path(), &out)), "--out", arg(&weights)]);
    let index = out.join("evaluation_index.json");
    let name = "synth:seed=3,first=7,scenes=2,frames=9,size=24";
    let scores = ["of the written", "of the named"].map(|scores| folder.path().join(scores));
    for (data, scores) in [arg(&out), name].into_iter().zip(&scores) {
        let eval = ["eval", "--weights", arg(&weights), "--data", data, "--index", arg(&index)];
        succeed(&[&eval[..], &["--out", arg(scores)]].concat());
        let files = std::fs::read_dir(scores.join("scenes")).unwrap().count();
        assert_eq!(files, 4, "scores and a picture of each scene");
    }

    let written = Dataset::open(&out, Split::Test).unwrap();
    let named = Dataset::open(Path::new(name), Split::Train).unwrap();
    assert_eq!(written.scenes(), 2);
    let keys = |data: &Dataset| data.groups.iter().flat_map(|g| g.keys.clone()).collect::<Vec<_>>();
    assert_eq!(keys(&written), keys(&named));
    let views = |data: &Dataset| {
        let key = &keys(data)[1];
        let group = data.groups.iter().find(|group| group.keys.contains(key)).unwrap();
        load_all_views(&group.open().unwrap().capture(key).unwrap(), None).unwrap()
    };
    for (a, b) in views(&written).iter().zip(&views(&named)) {
        assert!((a.camera.c2w - b.camera.c2w).abs_diff_eq(glam::DMat4::ZERO, 1e-5));
        // The written photos are JPEGs of high quality.
        let apart = (a.image.to_float() - b.image.to_float()).abs().mean(tch::Kind::Double).double_value(&[]);
        assert!(apart < 0.02, "{apart}");
    }
}

#[test]
fn names_of_synthetic_videos_are_checked() {
    let named = |name: &str| SyntheticDataset::named(Path::new(name));
    assert!(named("captures/synth").unwrap().is_none());
    assert_eq!(named("synth:scenes=3").unwrap().unwrap().keys(), ["0_000000", "0_000001", "0_000002"]);
    assert_eq!(named("synth:seed=4,scenes=1,first=9").unwrap().unwrap().keys(), ["4_000009"]);
    for (name, found) in [
        ("synth:", r#"a field is "", expected synth:seed=S,scenes=N"#),
        ("synth:scenes=1,", r#"a field is "", expected"#),
        ("synth:seed=1", "scenes is missing, expected"),
        ("synth:scenes=9000000", "scenes is 9000000, expected 1 to 1000000"),
        ("synth:scenes=some", r#"scenes is "some", expected"#),
        ("synth:scenes", r#"scenes is "", expected"#),
        ("synth:scenes=1,scenes=2", "scenes is repeated"),
        ("synth:scenes=1,color=red", r#"a field is "color", expected"#),
        ("synth:scenes=1,size=8", "size is 8, expected 16 to 8192"),
        ("synth:scenes=1,frames=2", "frames is 2, expected 3 to 10000"),
    ] {
        let error = named(name).unwrap_err().to_string();
        assert!(error.contains(found), "{name}: {error}");
    }
}

/// Views off the path look at what a view of the path looks at, from 30° aside or above and with nothing in between.
#[test]
fn views_off_the_path_are_the_test_part_of_a_capture() {
    let sandbox = Sandbox::empty();
    sandbox.run("synth --scenes 2 --frames 4 --off-path 6 --size 24 --depth --out @off");
    let capture = open_capture(&sandbox.path("off/0_000001")).unwrap();
    assert_eq!(capture.split(Holdout::None), ((0..4).collect(), (4..10).collect()));
    let video = Video::new(0, 1, &VideoSettings { off_path: 6, ..settings(4, 24) });
    let depths = sandbox.read("off/depth/0_000001.npy");
    let depths = NpyFile::new(&depths[..]).unwrap();
    assert_eq!(depths.shape(), [10, 24, 24]);
    let cameras = capture.cameras();
    for (index, camera) in cameras[4..].iter().enumerate() {
        assert!((camera.c2w - video.cameras()[4 + index].c2w).abs_diff_eq(DMat4::ZERO, 1e-9));
        let base = &cameras[index * 4 / 6];
        let [a, b] = [base, camera].map(|camera| camera.c2w.z_axis.truncate());
        assert!((a.angle_between(b).to_degrees() - 30.).abs() < 1e-3);
        // Both axes meet in a point that is visible in both images.
        let [near, far] = [base, camera].map(|camera| camera.c2w.w_axis.truncate());
        let meet = |from: DVec3, axis: DVec3, other: DVec3, with: DVec3| {
            let normal = with.cross(axis.cross(with));
            (other - from).dot(normal) / axis.dot(normal)
        };
        let target = far + b * meet(far, b, near, a);
        let distance = (target - near).reject_from_normalized(a).length() / near.distance(target);
        assert!(distance < 1e-4, "{distance}");
        let at = |frame: usize| f64::from(video.depth(frame)[12 * 24 + 12]);
        assert!(at(4 + index) > 0.7 * far.distance(target), "view {index}");
    }
    let photo = capture.load(&[5], None).unwrap().remove(0);
    assert!(photo.image.to_rgb() == video.photo(5), "without loss");
}

/// Objects are opaque in the middle of their images and transparent around it.
#[test]
fn objects_are_captures_with_transparent_images() {
    let sandbox = Sandbox::empty();
    sandbox.run("synth --objects --scenes 1 --frames 6 --off-path 2 --size 24 --out @objects");
    let capture = open_capture(&sandbox.path("objects/0_000000")).unwrap();
    assert_eq!(capture.split(Holdout::None), ((0..6).collect(), (6..8).collect()));
    let photos = capture.load_all(None).unwrap();
    for photo in &photos {
        let mask = photo.mask.as_ref().expect("transparent pixels");
        assert!(mask[12 * 24 + 12] == 255 && mask[0] == 0, "{}", photo.name);
    }
}
