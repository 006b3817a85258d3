//! The evaluation protocol on a dataset: `eval --data ROOT --index FILE --out DIR`.

use crate::common::has_lpips;
use crate::common::program::{Sandbox, assert_says, copy_dir};
use crate::common::room::write_rooms;
use globalsplat::data::{Dataset, Split};
use globalsplat::eval::{Evaluation, SceneScores, read_evaluation};
use globalsplat::io::{read_image, write_png};
use serde_json::{Value, json};
use std::path::Path;
use std::process::Stdio;
use std::sync::OnceLock;
use std::time::Duration;

/// Returns a dataset of three rooms with five 64×64 photos each in `captures`, the same in `chunks`, their splats in `splats`, and an index of
/// two of them that also names a missing scene; and untrained weights for images of 32×32.
fn dataset() -> Sandbox {
    static ORIGINAL: OnceLock<Sandbox> = OnceLock::new();
    let original = ORIGINAL.get_or_init(|| {
        let sandbox = Sandbox::with_weights();
        write_rooms(&sandbox.path("captures"), 3, 5, 64);
        sandbox.run("pack @captures --out @chunks");
        for room in ["room_000", "room_001", "room_002"] {
            sandbox.copy(&format!("captures/{room}/truth.ply"), &format!("splats/{room}.ply"));
        }
        let frames = json!({"context": [0, 2, 4], "target": [1, 3]});
        let index = json!({"room_002": frames, "room_000": frames, "absent": frames, "left_out": null});
        sandbox.write("re10k_3v.json", index.to_string());
        sandbox
    });
    let sandbox = Sandbox::empty();
    copy_dir(original.folder(), sandbox.folder());
    sandbox
}

const SPLATS: &str = "eval --splat @splats --render-height 64 --index @re10k_3v.json --out @out --data";
const MODEL: &str = "eval --weights @tiny.safetensors --index @re10k_3v.json --data";

fn read(sandbox: &Sandbox, folder: &str) -> Evaluation {
    read_evaluation(&sandbox.path(folder)).unwrap()
}

#[test]
fn splats_are_scored_by_an_index_from_chunks_and_captures_alike() {
    let sandbox = dataset();
    for data in ["chunks", "captures"] {
        let (out, err) = sandbox.succeed_with_messages(&format!("{SPLATS} @{data}"));
        assert_says(&out, &["2 of 3 scenes", "LPIPS-VGG absent"]);
        assert_says(&err, &["left out: lpips_vgg and lpips_alex", "make weights"]);
        let evaluation = read(&sandbox, "out");
        let names: Vec<&str> = evaluation.scenes.iter().map(|scene| scene.scores.scene.as_str()).collect();
        assert_eq!((names.as_slice(), evaluation.indexed_scenes), (["room_000", "room_002"].as_slice(), 3));
        // The photos were rendered from these splats: the only difference is the photos' 8-bit rounding.
        let mean = &evaluation.summary.mean;
        assert!(mean.psnr > 50. && mean.ssim > 0.999, "{:?}", evaluation.summary);
        assert_eq!((evaluation.dataset.as_str(), evaluation.context_views), ("re10k", 3));
        let views: Vec<&str> =
            evaluation.scenes[0].scores.views.iter().map(|view| view.image.as_str()).collect();
        assert_eq!(views, ["000001", "000003"]);
        for file in ["report.html", "scores.json", "scenes/room_000.jpg"] {
            assert!(sandbox.path("out").join(file).is_file(), "{file}");
        }
        assert_eq!(sandbox.text("out/scores.csv").lines().count(), 1 + 2 * 2);
        std::fs::remove_dir_all(sandbox.path("out")).unwrap();
    }
}

#[test]
fn an_interrupted_evaluation_resumes() {
    let sandbox = dataset();
    let eval = format!("{MODEL} @chunks --precision f32 --out @out");
    sandbox.succeed(&eval);
    let first = read(&sandbox, "out");
    let efficiency = first.efficiency.expect("a model's cost");
    assert_eq!(efficiency.timed_scenes, 1, "the first scene warms up");
    assert!(efficiency.forward_seconds > 0. && efficiency.peak_memory_bytes > 1_000_000);
    assert_eq!(first.image_size, [32, 32]);

    // One scene's scores are incomplete, as if it hadn't been done yet; those of the other are reused unchecked.
    sandbox.change_json("out/scenes/room_000.json", |scores| scores["psnr"] = json!(99.5));
    sandbox.write("out/scenes/room_002.json", "{\"scene\": \"room_002\", \"psn");
    sandbox.succeed(&eval);
    let second = read(&sandbox, "out");
    assert_eq!(second.scenes[0].scores.mean.psnr, 99.5);
    assert_eq!(second.scenes[1].scores.mean.psnr, first.scenes[1].scores.mean.psnr);

    // Scores of another subject, or of the same weights in another precision, must not be mixed with these.
    let half = format!("{MODEL} @chunks --precision bf16");
    for line in [format!("{SPLATS} @chunks"), format!("{half} --out @out")] {
        assert_says(&sandbox.refuse(&line), &["evaluation.json: the evaluation is of tiny.safetensors"]);
    }
    sandbox.succeed(&format!("{half} --out @half"));
    let half = read(&sandbox, "half");
    assert_eq!(half.method, "tiny bf16");
    let [ours, theirs] = [&half, &first].map(|evaluation| evaluation.scenes[1].scores.mean.psnr);
    assert!(ours != theirs && (ours - theirs).abs() < 0.2, "{ours} {theirs}");

    let index = json!({"room_000": {"context": [0, 1], "target": [3]}});
    sandbox.write("re10k_3v.json", index.to_string());
    assert_says(&sandbox.refuse(&eval), &["choose another --out"]);
}

/// Replaces the contents of a file without changing its size or modification time.
fn replace_unnoticed(sandbox: &Sandbox, name: &str, mut bytes: Vec<u8>) {
    let path = sandbox.path(name);
    let metadata = std::fs::metadata(&path).unwrap();
    let (length, modified) = (metadata.len() as usize, metadata.modified().unwrap());
    assert!(bytes.len() <= length, "{} bytes for {length}", bytes.len());
    // Decoders ignore bytes behind an image's end.
    bytes.resize(length, 0);
    std::fs::write(&path, bytes).unwrap();
    let file = std::fs::File::options().write(true).open(&path).unwrap();
    file.set_times(std::fs::FileTimes::new().set_modified(modified)).unwrap();
}

#[test]
fn changes_of_same_size_and_time_are_scored_again() {
    let sandbox = dataset();
    let photo = "captures/room_000/images/001.png";
    sandbox.write(photo, [sandbox.read(photo), vec![0; 1 << 20]].concat());
    let psnr = || {
        sandbox.succeed(&format!("{SPLATS} @captures"));
        let scenes = read(&sandbox, "out").scenes;
        <[f64; 2]>::try_from(scenes.iter().map(|scene| scene.scores.mean.psnr).collect::<Vec<_>>()).unwrap()
    };
    let first = psnr();
    // Scores that are reused as long as nothing changes.
    sandbox.change_json("out/scenes/room_002.json", |scores| scores["psnr"] = json!(99.5));
    replace_unnoticed(&sandbox, "splats/room_000.ply", sandbox.read("splats/room_001.ply"));
    let second = psnr();
    assert!(second[0] < first[0] - 10. && second[1] == 99.5, "another splat: {first:?} and {second:?}");
    replace_unnoticed(&sandbox, photo, sandbox.read("captures/room_002/images/000.png"));
    let third = psnr();
    assert!(third[0] != second[0] && third[1] == 99.5, "another photo: {second:?} and {third:?}");
    sandbox
        .change_json("captures/room_000/cameras.json", |json| json["views"][1]["c2w"][0][3] = json!(0.123));
    let fourth = psnr();
    assert!(fourth[0] != third[0] && fourth[1] == 99.5, "another camera: {third:?} and {fourth:?}");

    // LPIPS is added once its weights are available.
    if !has_lpips() {
        return;
    }
    let has_lpips = |scene: &SceneScores| scene.scores.mean.lpips_alex.is_some();
    assert!(!read(&sandbox, "out").scenes.iter().any(has_lpips));
    let mut eval = sandbox.command(&format!("{SPLATS} @captures"));
    assert!(eval.env_remove("GLOBALSPLAT_WEIGHTS").status().unwrap().success());
    assert!(read(&sandbox, "out").scenes.iter().all(has_lpips));
}

#[test]
fn synthetic_videos_are_identified_by_version() {
    let videos = Dataset::open(Path::new("synth:seed=1,scenes=1"), Split::Test).unwrap();
    assert!(videos.generator().unwrap().contains(env!("CARGO_PKG_VERSION")));
}

/// Follows a process until it ends, and returns its peak resident memory in bytes. What the system reports afterwards also counts the memory
/// that this process had when it started the other.
#[cfg(target_os = "linux")]
fn follow_peak(process: u32) -> u64 {
    let status = format!("/proc/{process}/status");
    let peak_now = || {
        let text = std::fs::read_to_string(&status).ok()?;
        let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
        Some(1024 * line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?)
    };
    let mut peak = 0;
    while let Some(now) = peak_now() {
        peak = now;
        std::thread::sleep(Duration::from_millis(1));
    }
    peak
}

#[cfg(target_os = "linux")]
#[test]
fn photos_are_scored_one_at_a_time() {
    // Each takes 24 MB as a tensor. Two photos take 0.7 GB with libtorch and what the allocator keeps; the others would take 0.9 GB more.
    const PHOTOS: u64 = 40;
    let (width, height) = (1632, 1224);
    let sandbox = Sandbox::new();
    std::fs::create_dir(sandbox.path("images")).unwrap();
    let rows = tch::Tensor::linspace(0., 1., height, (tch::Kind::Float, tch::Device::Cpu));
    let photo = rows.view([1, height, 1]).expand([3, height, width], false);
    write_png(&sandbox.path("images/000.png"), &photo).unwrap();
    let frame = |i: u64| {
        let file = format!("images/{i:03}.png");
        if i > 0 {
            std::fs::hard_link(sandbox.path("images/000.png"), sandbox.path(&file)).unwrap();
        }
        let x = i as f64 * 0.05;
        let pose = json!([[1., 0., 0., x], [0., 1., 0., 0.], [0., 0., 1., 2.], [0., 0., 0., 1.]]);
        json!({"file_path": file, "transform_matrix": pose})
    };
    let frames: Vec<Value> = (0..PHOTOS).map(frame).collect();
    let capture = json!({
        "w": width, "h": height, "fl_x": 1300., "fl_y": 1300., "cx": 816., "cy": 612., "frames": frames,
    });
    sandbox.write("transforms.json", capture.to_string());
    let line = "eval --splat @room/truth.ply --contact-sheet @sheet.png --scene @ --json";
    let process = sandbox.command(line).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let id = process.id();
    let follower = std::thread::spawn(move || follow_peak(id));
    let output = process.wait_with_output().unwrap();
    let peak = follower.join().unwrap();
    let err = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(0), "{err}");
    let scores: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(scores["views"].as_array().unwrap().len() as u64, PHOTOS);
    assert_says(&err, &["sheet.png: pictures are shrunk to 1/2"]);
    assert!(peak < 1_300_000_000, "{peak} bytes");
    // 40 rows of three images of 816×612, and the gaps.
    let size = read_image(&sandbox.path("sheet.png")).unwrap().dimensions();
    assert_eq!(size, (3 * 816 + 2 * 4, PHOTOS as u32 * 612 + (PHOTOS as u32 - 1) * 4));
}

#[test]
fn external_renders_are_scored_by_an_index() {
    let sandbox = dataset();
    for (room, folder) in [("room_000", "renders/room_000"), ("room_002", "renders/room_002/color")] {
        for frame in [1, 3] {
            sandbox
                .copy(&format!("captures/{room}/images/{frame:03}.png"), &format!("{folder}/{frame:06}.png"));
        }
    }
    let report = sandbox.json(
        "eval --renders @renders --name 'the photos' --render-height 64 --data @chunks --index @re10k_3v.json --out @out",
    );
    assert_eq!(report["evaluations"][0]["summary"], json!({"psnr": 100., "cc_psnr": 100., "ssim": 1.}));
    assert_eq!(read(&sandbox, "out").method, "the photos");
}

#[test]
fn several_indices_make_one_report() {
    let sandbox = dataset();
    let index = json!({"room_001": {"context": [0, 4], "target": [2]}}).to_string();
    ["acid_2v.json", "other/acid_2v.json"].iter().for_each(|name| sandbox.write(name, &index));
    let eval = format!("{SPLATS} @chunks --index @acid_2v.json");
    sandbox.succeed(&eval);
    assert_says(&sandbox.text("out/report.html"), &["room_001", "room_002"]);
    assert_eq!(read(&sandbox, "out/acid_2v").dataset, "acid");
    let error = sandbox.refuse(&format!("{eval} --index @other/acid_2v.json"));
    assert_says(&error, &["two of them would go to"]);

    // --dataset decides over the name of the index.
    sandbox.write("acid_from_re10k_2v.json", &index);
    let eval = SPLATS.replace("re10k_3v", "acid_from_re10k_2v").replace("@out", "@named");
    sandbox.succeed(&format!("{eval} @chunks --dataset ACID"));
    assert_eq!(read(&sandbox, "named").dataset, "acid");
}

#[test]
fn images_are_scored_at_the_height_that_is_asked_for() {
    let sandbox = dataset();
    let eval = "eval --splat @splats/room_000.ply --scene @captures/room_000 --render-height";
    let psnr = |height: u32| sandbox.json(&format!("{eval} {height}"))["psnr"].as_f64();
    assert!(psnr(64) > psnr(32), "the photos were rendered at 64");
    let error = sandbox.refuse(&format!("{eval} 8"));
    assert_says(&error, &["--render-height is 8, expected images with sides of 11 to 16384"]);
}

#[test]
fn invalid_indices_are_refused() {
    let sandbox = dataset();
    let error = sandbox.refuse(&format!("{} @chunks", SPLATS.replace("@splats", "@splats/room_000.ply")));
    assert_says(&error, &["room_000.ply: what is to be scored is no folder"]);
    let eval = format!("{SPLATS} @chunks");
    let write = |index: Value| sandbox.write("re10k_3v.json", index.to_string());
    write(json!({"elsewhere": {"context": [0, 7], "target": [1]}}));
    assert_says(&sandbox.refuse(&eval), &["none of the 3 in the dataset chunks"]);
    write(json!({"room_000": {"context": [0, 3], "target": [1]}}));
    for file in ["splats/room_000.ply", "chunks/000000.torch"] {
        std::fs::remove_file(sandbox.path(file)).unwrap();
        let (code, _, error) = sandbox.output(&eval);
        assert_eq!(code, Some(1), "{error}");
        let name = file.split('/').next_back().unwrap();
        assert_says(&error, &["room_000: ", &format!("{name} can't be read")]);
    }
    // Files that no evaluation wrote are kept.
    sandbox.write("foreign/scores.csv", "mine");
    let error = sandbox.refuse(&eval.replace("@out", "@foreign"));
    assert_says(&error, &["a scores.csv that no evaluation wrote"]);
    assert_eq!(sandbox.text("foreign/scores.csv"), "mine");
}

#[test]
fn a_scene_that_fails_is_named_and_the_first_of_the_others_warms_up() {
    let sandbox = dataset();
    let photo = "captures/room_000/images/000.png";
    let bytes = sandbox.read(photo);
    sandbox.write(photo, &bytes[..bytes.len() / 2]);
    let frames = json!({"context": [0, 2, 4], "target": [1, 3]});
    let index = json!({"room_000": frames, "room_001": frames, "room_002": frames});
    sandbox.write("re10k_3v.json", index.to_string());
    let eval = format!("{MODEL} @captures --out @out");
    let (code, _, err) = sandbox.output(&eval);
    assert_eq!(code, Some(1), "{err}");
    let undecodable = "images/000.png: the image is undecodable";
    assert_says(&err, &["room_000: ", undecodable, "1 scenes could not be scored"]);
    let evaluation = read(&sandbox, "out");
    assert_eq!((evaluation.scenes.len(), evaluation.failures.len()), (2, 1));
    let efficiency = evaluation.efficiency.expect("a model's cost");
    assert!(efficiency.timed_scenes == 1 && efficiency.peak_memory_bytes > 1_000_000);
    let [first, second] = evaluation.scenes.as_slice() else { panic!("two scenes") };
    assert!(first.warm_up && first.peak_memory_bytes.is_some());
    assert!(!second.warm_up && second.peak_memory_bytes.is_none());

    // Once the photo is repaired, the same command does the rest.
    sandbox.write(photo, bytes);
    sandbox.succeed(&eval);
    let evaluation = read(&sandbox, "out");
    assert_eq!((evaluation.scenes.len(), evaluation.failures.len()), (3, 0));
}
