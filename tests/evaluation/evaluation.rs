//! The evaluation protocol on a dataset: `eval --data ROOT --index FILE --out DIR`.

use crate::common::has_lpips;
use crate::common::program::{arg, command, fail, refuse, room, rooms, succeed, text, tiny_weights};
use globalsplat::data::{Dataset, Split};
use globalsplat::eval::{SceneScores, read_evaluation};
use globalsplat::io::{read_image, write_png};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Dataset of three rooms with five 256×256 photos each in `captures/`, the same in `chunks/`, their splats in `splats/`, and
/// an index of two of them that also names a missing scene.
struct Set {
    folder: TempDir,
}

impl Set {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let captures = folder.path().join("captures");
        rooms(&captures, 3, 5, 256);
        succeed(&["pack", arg(&captures), "--out", arg(&folder.path().join("chunks"))]);
        std::fs::create_dir(folder.path().join("splats")).unwrap();
        for room in ["room_000", "room_001", "room_002"] {
            let splat = folder.path().join(format!("splats/{room}.ply"));
            std::fs::copy(captures.join(room).join("truth.ply"), splat).unwrap();
        }
        let set = Set { folder };
        let frames = json!({"context": [0, 2, 4], "target": [1, 3]});
        set.write_index(&json!({"room_002": frames, "room_000": frames, "absent": frames, "left_out": null}));
        set
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write_index(&self, index: &Value) {
        std::fs::write(self.path("re10k_3v.json"), index.to_string()).unwrap();
    }

    /// Returns the arguments for a subject and a dataset.
    fn arguments(&self, subject: &[&str], data: &str) -> Vec<String> {
        let (data, index, out) = (self.path(data), self.path("re10k_3v.json"), self.path("out"));
        let rest = ["--data", arg(&data), "--index", arg(&index), "--out", arg(&out)];
        ["eval"].iter().chain(subject).chain(&rest).map(|argument| argument.to_string()).collect()
    }
}

/// Runs the command without LPIPS, which takes longer than all the rest.
fn run(arguments: &[String], folder: &Path) -> (Option<i32>, String, String) {
    let output = command(&text(arguments)).env("GLOBALSPLAT_WEIGHTS", folder).output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

#[test]
fn splats_are_scored_by_an_index_from_chunks_and_captures_alike() {
    let set = Set::new();
    let splats = set.path("splats");
    for data in ["chunks", "captures"] {
        let (code, out, err) = run(&set.arguments(&["--splat", arg(&splats)], data), set.folder.path());
        assert_eq!(code, Some(0), "{err}");
        assert!(out.contains("2 of 3 scenes") && out.contains("LPIPS-VGG absent"), "{out}");
        assert!(err.contains("left out: lpips_vgg and lpips_alex") && err.contains("make weights"), "{err}");
        let evaluation = read_evaluation(&set.path("out")).unwrap();
        let names: Vec<&str> = evaluation.scenes.iter().map(|scene| scene.scores.scene.as_str()).collect();
        assert_eq!((names.as_slice(), evaluation.indexed_scenes), (["room_000", "room_002"].as_slice(), 3));
        // The photos were rendered from these splats: the only difference is the photos' 8-bit rounding.
        assert!(
            evaluation.summary.mean.psnr > 50. && evaluation.summary.mean.ssim > 0.999,
            "{:?}",
            evaluation.summary
        );
        assert_eq!((evaluation.dataset.as_str(), evaluation.context_views), ("re10k", 3));
        let views: Vec<&str> =
            evaluation.scenes[0].scores.views.iter().map(|view| view.image.as_str()).collect();
        assert_eq!(views, ["000001", "000003"]);
        for file in ["report.html", "scores.json", "scores.csv", "scenes/room_000.jpg"] {
            assert!(set.path("out").join(file).is_file(), "{file}");
        }
        let csv = std::fs::read_to_string(set.path("out/scores.csv")).unwrap();
        assert_eq!(csv.lines().count(), 1 + 2 * 2);
        std::fs::remove_dir_all(set.path("out")).unwrap();
    }
}

#[test]
fn an_interrupted_evaluation_resumes() {
    let set = Set::new();
    let weights = tiny_weights(set.folder.path(), &set.path("captures"));
    let arguments = set.arguments(&["--precision", "f32", "--weights", arg(&weights)], "chunks");
    assert_eq!(run(&arguments, set.folder.path()).0, Some(0));
    let first = read_evaluation(&set.path("out")).unwrap();
    let efficiency = first.efficiency.expect("a model's cost");
    assert_eq!(efficiency.timed_scenes, 1, "the first scene warms up");
    assert!(efficiency.forward_seconds > 0. && efficiency.peak_memory_bytes > 1_000_000);
    assert_eq!(first.image_size, [32, 32]);

    // One scene's scores are incomplete, as if it hadn't been done yet; those of the other are reused unchecked.
    let kept = set.path("out/scenes/room_000.json");
    let mut scores: Value = serde_json::from_slice(&std::fs::read(&kept).unwrap()).unwrap();
    scores["psnr"] = json!(99.5);
    std::fs::write(&kept, scores.to_string()).unwrap();
    std::fs::write(set.path("out/scenes/room_002.json"), "{\"scene\": \"room_002\", \"psn").unwrap();
    assert_eq!(run(&arguments, set.folder.path()).0, Some(0));
    let second = read_evaluation(&set.path("out")).unwrap();
    assert_eq!(second.scenes[0].scores.mean.psnr, 99.5);
    assert_eq!(second.scenes[1].scores.mean.psnr, first.scenes[1].scores.mean.psnr);

    // Scores of another subject must not be mixed with these.
    let splats = set.path("splats");
    let error = refuse(&text(&set.arguments(&["--splat", arg(&splats)], "chunks")));
    assert!(error.contains("evaluation.json: the evaluation is of tiny.safetensors"), "{error}");
    // Scores of the same weights in another precision must not, either.
    let half = set.arguments(&["--precision", "bf16", "--weights", arg(&weights)], "chunks");
    let (code, _, err) = run(&half, set.folder.path());
    // The line before it may warn that bf16 is slower.
    let refusal = err.lines().last().unwrap_or_default();
    assert!(
        code == Some(2) && refusal.contains("evaluation.json: the evaluation is of tiny.safetensors"),
        "{err}"
    );
    let elsewhere = set.path("half");
    let half: Vec<String> = half
        .into_iter()
        .map(|a| if a == arg(&set.path("out")) { arg(&elsewhere).into() } else { a })
        .collect();
    assert_eq!(run(&half, set.folder.path()).0, Some(0));
    let half = read_evaluation(&elsewhere).unwrap();
    assert_eq!(half.method, "tiny bf16");
    assert_ne!(half.scenes[1].scores.mean.psnr, first.scenes[1].scores.mean.psnr);
    assert!((half.scenes[1].scores.mean.psnr - first.scenes[1].scores.mean.psnr).abs() < 0.2);

    let index = json!({"room_000": {"context": [0, 1], "target": [3]}});
    set.write_index(&index);
    let error = refuse(&text(&arguments));
    assert!(error.contains("choose another --out"), "{error}");
}

/// Replaces the contents of the file at `path` without changing its size or modification time.
fn replace_unnoticed(path: &Path, mut bytes: Vec<u8>) {
    let metadata = std::fs::metadata(path).unwrap();
    let (length, modified) = (metadata.len() as usize, metadata.modified().unwrap());
    assert!(bytes.len() <= length, "{} bytes for {length}", bytes.len());
    // Decoders ignore bytes behind an image's end.
    bytes.resize(length, 0);
    std::fs::write(path, bytes).unwrap();
    let file = std::fs::File::options().write(true).open(path).unwrap();
    file.set_times(std::fs::FileTimes::new().set_modified(modified)).unwrap();
}

#[test]
fn changes_of_same_size_and_time_are_scored_again() {
    let set = Set::new();
    let photo = set.path("captures/room_000/images/001.png");
    std::fs::write(&photo, [std::fs::read(&photo).unwrap(), vec![0; 1 << 20]].concat()).unwrap();
    let arguments = set.arguments(&["--splat", arg(&set.path("splats"))], "captures");
    let psnr = || {
        let (code, _, err) = run(&arguments, set.folder.path());
        assert_eq!(code, Some(0), "{err}");
        let evaluation = read_evaluation(&set.path("out")).unwrap();
        evaluation.scenes.iter().map(|scene| scene.scores.mean.psnr).collect::<Vec<_>>()
    };
    let first = psnr();
    // Scores that are reused as long as nothing changes.
    let kept = set.path("out/scenes/room_002.json");
    let mut scores: Value = serde_json::from_slice(&std::fs::read(&kept).unwrap()).unwrap();
    scores["psnr"] = json!(99.5);
    std::fs::write(&kept, scores.to_string()).unwrap();

    let read = |name: &str| std::fs::read(set.path(name)).unwrap();
    replace_unnoticed(&set.path("splats/room_000.ply"), read("splats/room_001.ply"));
    let second = psnr();
    assert!(second[0] < first[0] - 10. && second[1] == 99.5, "another splat: {first:?} and {second:?}");
    replace_unnoticed(&photo, read("captures/room_002/images/000.png"));
    let third = psnr();
    assert!(third[0] != second[0] && third[1] == 99.5, "another photo: {second:?} and {third:?}");
    let cameras = "captures/room_000/cameras.json";
    let mut moved: Value = serde_json::from_slice(&read(cameras)).unwrap();
    moved["views"][1]["c2w"][0][3] = json!(0.123);
    std::fs::write(set.path(cameras), moved.to_string()).unwrap();
    let fourth = psnr();
    assert!(fourth[0] != third[0] && fourth[1] == 99.5, "another camera: {third:?} and {fourth:?}");

    // LPIPS is added once its weights are available.
    if !has_lpips() {
        return;
    }
    let has_lpips = |scene: &SceneScores| scene.scores.mean.lpips_alex.is_some();
    assert!(!read_evaluation(&set.path("out")).unwrap().scenes.iter().any(has_lpips));
    succeed(&text(&arguments));
    assert!(read_evaluation(&set.path("out")).unwrap().scenes.iter().all(has_lpips));
}

#[test]
fn synthetic_videos_are_identified_by_version_and_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let made_by = |pictures: &str| {
        let name = format!("synth:seed=1,scenes=1{pictures}");
        Dataset::open(Path::new(&name), Split::Test).unwrap().generator().map(String::from)
    };
    let with_pictures = |grey: f64| {
        let picture = tch::Tensor::full([3, 16, 16], grey, (tch::Kind::Float, tch::Device::Cpu));
        write_png(&folder.path().join("a.png"), &picture).unwrap();
        made_by(&format!(",pictures={}", folder.path().display()))
    };
    let (black, grey) = (with_pictures(0.), with_pictures(0.5));
    assert!(black != grey && with_pictures(0.5) == grey, "{black:?} and {grey:?}");
    assert!(made_by("").is_some_and(|by| by.contains(env!("CARGO_PKG_VERSION")) && Some(by) != grey));
}

/// Returns the largest resident size of this process's terminated children, in bytes.
fn peak_of_children() -> u64 {
    // SAFETY: rusage is plain data for which zero is valid, and getrusage only writes to it.
    let usage = unsafe {
        let mut usage: libc::rusage = std::mem::zeroed();
        libc::getrusage(libc::RUSAGE_CHILDREN, &mut usage);
        usage
    };
    usage.ru_maxrss as u64 * if cfg!(target_os = "macos") { 1 } else { 1024 }
}

#[test]
fn photos_are_scored_one_at_a_time() {
    // Each takes 24 MB as a tensor, and as much again as a render.
    const PHOTOS: u64 = 40;
    let (width, height) = (1632, 1224);
    let folder = tempfile::tempdir().unwrap();
    let images = folder.path().join("images");
    std::fs::create_dir(&images).unwrap();
    let rows = tch::Tensor::linspace(0., 1., height, (tch::Kind::Float, tch::Device::Cpu));
    let photo = rows.view([1, height, 1]).expand([3, height, width], false);
    write_png(&images.join("000.png"), &photo).unwrap();
    let frame = |i: u64| {
        let file = format!("images/{i:03}.png");
        if i > 0 {
            std::fs::hard_link(images.join("000.png"), folder.path().join(&file)).unwrap();
        }
        let at = i as f64 * 0.05;
        let pose = json!([[1., 0., 0., at], [0., 1., 0., 0.], [0., 0., 1., 2.], [0., 0., 0., 1.]]);
        json!({"file_path": file, "transform_matrix": pose})
    };
    let frames: Vec<Value> = (0..PHOTOS).map(frame).collect();
    let capture = json!({
        "w": width, "h": height, "fl_x": 1300., "fl_y": 1300., "cx": 816., "cy": 612., "frames": frames,
    });
    std::fs::write(folder.path().join("transforms.json"), capture.to_string()).unwrap();
    let (_rooms, room) = room();
    let (splat, sheet) = (room.join("truth.ply"), folder.path().join("sheet.png"));
    let scene = ["--scene", arg(folder.path()), "--json"];
    for subject in
        [&["--splat", arg(&splat), "--contact-sheet", arg(&sheet)][..], &["--renders", arg(&images)]]
    {
        let arguments: Vec<String> =
            ["eval"].iter().chain(subject).chain(&scene).map(|argument| argument.to_string()).collect();
        let (code, out, err) = run(&arguments, folder.path());
        assert_eq!(code, Some(0), "{err}");
        let scores: Value = serde_json::from_str(&out).unwrap();
        assert_eq!(scores["views"].as_array().unwrap().len() as u64, PHOTOS);
        let is_shrunk = err.contains("sheet.png: pictures are shrunk to 1/2");
        assert_eq!(is_shrunk, subject.contains(&"--contact-sheet"), "{err}");
        let peak = peak_of_children();
        assert!(peak < PHOTOS * 24_000_000, "{subject:?}: {peak} bytes");
    }
    // 40 rows of three images of 816×612, and the gaps.
    let size = read_image(&sheet).unwrap().dimensions();
    assert_eq!(size, (3 * 816 + 2 * 4, PHOTOS as u32 * 612 + (PHOTOS as u32 - 1) * 4));
}

#[test]
fn external_renders_are_scored_by_an_index() {
    let set = Set::new();
    for (room, folder) in [("room_000", "renders/room_000"), ("room_002", "renders/room_002/color")] {
        let folder = set.path(folder);
        std::fs::create_dir_all(&folder).unwrap();
        for frame in [1, 3] {
            let photo = set.path(&format!("captures/{room}/images/{frame:03}.png"));
            std::fs::copy(photo, folder.join(format!("{frame:06}.png"))).unwrap();
        }
    }
    let renders = set.path("renders");
    let arguments = set.arguments(&["--renders", arg(&renders), "--name", "the photos", "--json"], "chunks");
    let (code, out, err) = run(&arguments, set.folder.path());
    assert_eq!(code, Some(0), "{err}");
    let report: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(report["evaluations"][0]["summary"], json!({"psnr": 100., "ssim": 1.}));
    assert_eq!(read_evaluation(&set.path("out")).unwrap().method, "the photos");
}

#[test]
fn several_indices_make_one_report() {
    let set = Set::new();
    let splats = set.path("splats");
    let more = set.path("acid_2v.json");
    std::fs::write(&more, json!({"room_001": {"context": [0, 4], "target": [2]}}).to_string()).unwrap();
    let mut arguments = set.arguments(&["--splat", arg(&splats)], "chunks");
    arguments.extend(["--index".into(), arg(&more).into()]);
    let (code, _, err) = run(&arguments, set.folder.path());
    assert_eq!(code, Some(0), "{err}");
    let report = std::fs::read_to_string(set.path("out/report.html")).unwrap();
    assert!(report.contains("room_001") && report.contains("room_002"));
    assert_eq!(read_evaluation(&set.path("out/acid_2v")).unwrap().dataset, "acid");
    let twice = set.path("other/acid_2v.json");
    std::fs::create_dir(set.path("other")).unwrap();
    std::fs::copy(&more, &twice).unwrap();
    arguments.extend(["--index".into(), arg(&twice).into()]);
    assert!(refuse(&text(&arguments)).contains("two of them would go to"));
}

#[test]
fn ambiguous_dataset_names_are_refused() {
    let set = Set::new();
    let splats = set.path("splats");
    let frames = std::fs::read(set.path("re10k_3v.json")).unwrap();
    let named = |data: &str, index: &str| -> Vec<String> {
        std::fs::write(set.path(index), &frames).unwrap();
        let mut arguments = set.arguments(&["--splat", arg(&splats)], data);
        let at = arguments.iter().position(|argument| argument == "--index").expect("an index");
        arguments[at + 1] = arg(&set.path(index)).into();
        arguments
    };
    // The index has two names, and the folder has neither.
    let mut ambiguous = named("chunks", "acid_from_re10k_3v.json");
    let error = refuse(&text(&ambiguous));
    assert!(error.contains("acid_from_re10k_3v.json: ") && error.contains("acid or re10k"), "{error}");
    assert!(error.contains("--dataset"), "{error}");
    assert!(!set.path("out").exists(), "nothing was begun");
    ambiguous.extend(["--dataset".into(), "ACID".into()]);
    assert_eq!(run(&ambiguous, set.folder.path()).0, Some(0));
    assert_eq!(read_evaluation(&set.path("out")).unwrap().dataset, "acid");
}

#[test]
fn images_are_scored_at_the_height_that_is_asked_for() {
    let set = Set::new();
    let (room, splat) = (set.path("captures/room_000"), set.path("splats/room_000.ply"));
    let arguments = ["eval", "--splat", arg(&splat), "--scene", arg(&room), "--json", "--render-height"];
    let psnr = |height: &str| -> Value {
        let output = [&arguments[..], &[height]].concat();
        let (code, out, err) =
            run(&output.iter().map(|a| a.to_string()).collect::<Vec<_>>(), set.folder.path());
        assert_eq!(code, Some(0), "{err}");
        serde_json::from_str::<Value>(&out).unwrap()["psnr"].clone()
    };
    assert!(psnr("256").as_f64() > psnr("64").as_f64(), "the photos were rendered at 256");
    let error = refuse(&[&arguments[..], &["8"]].concat());
    assert!(error.contains("--render-height is 8, expected images with sides of 11 to 16384"), "{error}");
}

#[test]
fn invalid_indices_are_refused() {
    let set = Set::new();
    let splats = set.path("splats");
    let one = splats.join("room_000.ply");
    let error = refuse(&text(&set.arguments(&["--splat", arg(&one)], "chunks")));
    assert!(error.contains("room_000.ply: what is to be scored is no folder"), "{error}");
    let arguments = set.arguments(&["--splat", arg(&splats)], "chunks");
    set.write_index(&json!({"room_000": {"context": [0, 7], "target": [1]}}));
    let error = fail(&text(&arguments), 1);
    let expected = "re10k_3v.json: a frame of scene room_000 is 7, expected one of the scene's 5, 0 to 4";
    assert!(error.contains(expected), "{error}");
    set.write_index(&json!({"elsewhere": {"context": [0, 7], "target": [1]}}));
    let error = refuse(&text(&arguments));
    assert!(error.contains("none of the 3 in the dataset chunks"), "{error}");
    std::fs::remove_file(set.path("splats/room_000.ply")).unwrap();
    set.write_index(&json!({"room_000": {"context": [0, 3], "target": [1]}}));
    let error = fail(&text(&arguments), 1);
    assert!(error.contains("room_000: ") && error.contains("room_000.ply can't be read"), "{error}");
    std::fs::remove_file(set.path("chunks/000000.torch")).unwrap();
    let error = fail(&text(&arguments), 1);
    assert!(error.contains("room_000: ") && error.contains("000000.torch can't be read"), "{error}");
}

#[test]
fn a_scene_that_fails_is_named_and_the_first_of_the_others_warms_up() {
    let set = Set::new();
    let weights = tiny_weights(set.folder.path(), &set.path("captures"));
    let photo = set.path("captures/room_000/images/000.png");
    let bytes = std::fs::read(&photo).unwrap();
    std::fs::write(&photo, &bytes[..bytes.len() / 2]).unwrap();
    let frames = json!({"context": [0, 2, 4], "target": [1, 3]});
    set.write_index(&json!({"room_000": frames, "room_001": frames, "room_002": frames}));
    let arguments = set.arguments(&["--weights", arg(&weights)], "captures");
    let (code, _, err) = run(&arguments, set.folder.path());
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("room_000: ") && err.contains("images/000.png: the image is undecodable"), "{err}");
    assert!(err.contains("1 scenes could not be scored"), "{err}");
    let evaluation = read_evaluation(&set.path("out")).unwrap();
    assert_eq!((evaluation.scenes.len(), evaluation.failures.len()), (2, 1));
    let efficiency = evaluation.efficiency.expect("a model's cost");
    assert_eq!(efficiency.timed_scenes, 1);
    assert!(efficiency.peak_memory_bytes > 1_000_000);
    let [first, second] = evaluation.scenes.as_slice() else { panic!("two scenes") };
    assert!(first.warm_up && first.peak_memory_bytes.is_some());
    assert!(!second.warm_up && second.peak_memory_bytes.is_none());

    // Once the photo is repaired, the same command does the rest.
    std::fs::write(&photo, bytes).unwrap();
    assert_eq!(run(&arguments, set.folder.path()).0, Some(0));
    let evaluation = read_evaluation(&set.path("out")).unwrap();
    assert_eq!((evaluation.scenes.len(), evaluation.failures.len()), (3, 0));
}

#[test]
fn foreign_scores_are_not_overwritten() {
    let set = Set::new();
    let (splats, scores) = (set.path("splats"), set.path("out/scores.csv"));
    std::fs::create_dir(set.path("out")).unwrap();
    std::fs::write(&scores, "mine").unwrap();
    let (code, _, err) = run(&set.arguments(&["--splat", arg(&splats)], "chunks"), set.folder.path());
    assert!(code == Some(2) && err.contains("a scores.csv that no evaluation wrote"), "{err}");
    assert_eq!(std::fs::read_to_string(&scores).unwrap(), "mine");
}
