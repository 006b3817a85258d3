//! Outputs replace neither inputs of the command, nor files of others, nor anything but regular files.
#![cfg(unix)]

use crate::common::has_viewer;
use crate::common::program::{Sandbox, arg, assert_says};
use crate::common::room::{write_room, write_rooms};
use globalsplat::io::{read_image, read_splat};
use globalsplat::train::list_checkpoints;
use serde_json::json;
use std::fs;
use std::os::unix::fs::{FileTypeExt, MetadataExt, symlink};
use std::process::Command;

const NOTES: &str = "what somebody wrote";

/// Asserts that each command is refused because its output is an input, and changes no file.
#[track_caller]
fn refuse_all(sandbox: &Sandbox, lines: &[&str]) {
    let before = sandbox.contents();
    let found =
        ["a photo of the capture", "a file that this command reads", "a folder with the capture's photos"];
    for line in lines {
        let error = sandbox.refuse(line);
        let is_refused = found.iter().any(|found| error.contains(&format!("the output is {found}")));
        assert!(is_refused, "{line}: {error}");
        assert!(sandbox.contents() == before, "{line} changed a file");
    }
}

#[test]
fn pictures_replace_nothing_that_is_read() {
    let sandbox = Sandbox::with_weights();
    let photo = sandbox.path("room/images/000.png");
    symlink(sandbox.path("room/images"), sandbox.path("linked")).unwrap();
    // A link to a photo, named like an output file, in a folder below the output.
    fs::create_dir(sandbox.path("below")).unwrap();
    symlink(&photo, sandbox.path("below/000.png")).unwrap();
    let pose: Vec<f64> = (0..16).map(|i| f64::from(u8::from(i % 5 == 0))).collect();
    let camera = json!({"camera_to_world": pose, "fov": 60});
    let path = json!({"camera_path": [camera], "render_height": 24, "render_width": 24});
    sandbox.write("path.json", path.to_string());
    symlink(sandbox.path("path.json"), sandbox.path("path.json.png")).unwrap();
    refuse_all(
        &sandbox,
        &[
            "render --splat @room/truth.ply --path @room --out @room/images",
            "render --splat @room/truth.ply --path @room --out @linked",
            "render --splat @room/truth.ply --path @room --out @below",
            "render --splat @room/truth.ply --path @room --frames 3 --out @room/images",
            "render --splat @room/truth.ply --path @room --out @room/images/000.png",
            "render --splat @room/truth.ply --path @path.json --out @path.json.png",
            "render --splat @room/truth.ply --scene @room --out @room/images",
            "render --splat @room/truth.ply --scene @room --orbit --frames 3 --out @room/images",
            "render --splat @room/truth.ply --scene @room --depth --out @room/images/000.png",
            "render --weights @tiny.safetensors --scene @room --out @room/images",
            "eval --splat @room/truth.ply --scene @room --contact-sheet @room/images/000.png",
            "eval --weights @tiny.safetensors --scene @room --contact-sheet @room/images/000.png",
            "refine --splat @room/truth.ply --scene @room --out @room/truth.ply --contact-sheet @room/images/000.png",
        ],
    );
}

#[test]
fn splats_and_weights_replace_nothing_that_is_read() {
    let sandbox = Sandbox::with_weights();
    sandbox.copy("room/truth.ply", "splat.ply");
    for (file, link) in [
        ("room/cameras.json", "cameras.ply"),
        ("tiny.safetensors", "weights.ply"),
        ("splat.ply", "page.html"),
    ] {
        symlink(sandbox.path(file), sandbox.path(link)).unwrap();
    }
    symlink("room", sandbox.path("rooms")).unwrap();
    sandbox.run("train --config @tiny.toml --out @run --set train.steps=2");
    refuse_all(
        &sandbox,
        &[
            "reconstruct --weights @tiny.safetensors --scene @room --out @cameras.ply",
            "reconstruct --weights @tiny.safetensors --scene @room --out @weights.ply",
            "reconstruct --weights @tiny.safetensors --scene @room --refine 1s --out @weights.ply",
            "refine --scene @room --steps 1 --out @cameras.ply",
            "convert @splat.ply @cameras.ply --scene @room",
            "convert @splat.ply @new.ply --scene @room --cameras-out @rooms/../new.ply",
            "convert @splat.ply @new.ply --scene @room --cameras-out @new.ply.origin.json",
            "export --config @tiny.toml --out @tiny.toml",
            "export --run @run --out @run/checkpoints/step-00000002/model.safetensors",
            "export --run @run --out @run/config.toml",
            "import --from @tiny.safetensors --out @tiny.safetensors",
        ],
    );
    if has_viewer() {
        refuse_all(&sandbox, &["render --splat @splat.ply --scene @room --html @page.html"]);
    }
    // The input splat may be replaced: it is read before.
    sandbox.run("convert @splat.ply @splat.ply --sh-degree 0");
    let id = || fs::metadata(sandbox.path("splat.ply")).unwrap().ino();
    let before = id();
    sandbox.run("refine --splat @splat.ply --scene @room --steps 2 --out @splat.ply");
    assert!(id() != before);
    // New files beside the photos, and beside a run's files, are allowed.
    sandbox.run("convert @splat.ply @room/mine.ply");
    (0..2).for_each(|_| sandbox.run("export --run @run --out @run/model.safetensors"));
}

#[test]
fn folders_of_outputs_replace_nothing_that_is_read() {
    let sandbox = Sandbox::with_weights();
    write_rooms(&sandbox.path("data"), 2, 9, 40);
    let frames = json!({"context": [0, 2, 4], "target": [1, 3]});
    let index = json!({"room_000": frames, "room_001": frames}).to_string();
    // Indices, splats and images at the paths of the outputs.
    ["index.json", "scored/scores.json"].iter().for_each(|name| sandbox.write(name, &index));
    for scene in ["room_000", "room_001"] {
        sandbox.copy(&format!("data/{scene}/truth.ply"), &format!("splats/{scene}.ply"));
        for frame in ["001", "003"] {
            sandbox
                .copy(&format!("data/{scene}/images/{frame}.png"), &format!("renders/{scene}/{frame}.png"));
        }
    }
    fs::create_dir_all(sandbox.path("of_renders/scenes")).unwrap();
    symlink(sandbox.path("renders/room_000/001.png"), sandbox.path("of_renders/scenes/room_000.jpg"))
        .unwrap();
    refuse_all(
        &sandbox,
        &[
            "eval --data @data --index @index.json --weights @tiny.safetensors --out @data/room_000/images",
            "eval --data @data --index @scored/scores.json --splat @splats --out @scored",
            "eval --data @data --index @index.json --renders @renders --out @of_renders",
            "pack @data/room_000 --out @data/room_000/images",
            "train --config @tiny.toml --out @room/images",
        ],
    );
    // An evaluation that is repeated resumes on its own files, also in a folder of the dataset.
    for _ in 0..2 {
        sandbox.succeed(
            "eval --data @data --index @index.json --splat @splats --render-height 40 --out @data/room_000/scores",
        );
    }
    // A report may be written beside the scores that it shows, but must not replace them.
    for name in ["scores.json", "evaluation.json", "scenes/room_000.jpg"] {
        refuse_all(&sandbox, &[&format!("report @data/room_000/scores --out @data/room_000/scores/{name}")]);
    }
    sandbox.run("report @data/room_000/scores --out @data/room_000/scores/report.html");
    // A run may be trained with its own configuration.
    sandbox.run("train --config @tiny.toml --out @run --set train.steps=2");
    sandbox.run("train --config @run/config.toml --out @run --set train.steps=3");
}

#[test]
fn special_files_are_not_replaced() {
    let sandbox = Sandbox::with_weights();
    let fifo = sandbox.path("fifo");
    assert!(Command::new("mkfifo").arg(&fifo).status().unwrap().success());
    let links = ["link", "link.ply", "link.png", "link.gif", "link.safetensors"];
    links.iter().for_each(|link| symlink(&fifo, sandbox.path(link)).unwrap());
    for (line, link) in [
        ("convert @room/truth.ply", "link.ply"),
        ("refine --scene @room --steps 1 --out", "link.ply"),
        ("reconstruct --scene @room --out", "link.ply"),
        ("render --splat @room/truth.ply --scene @room --out", "link.png"),
        ("render --splat @room/truth.ply --scene @room --out", "link.gif"),
        ("render --splat @room/truth.ply --scene @room --out", "link"),
        ("eval --splat @room/truth.ply --scene @room --contact-sheet", "link.png"),
        ("export --config @tiny.toml --out", "link.safetensors"),
        ("pack @room --out", "link"),
        ("synth --out", "link"),
        ("train --config @tiny.toml --out", "link"),
    ] {
        let error = sandbox.refuse(&format!("{line} @{link}"));
        assert_says(&error, &[&format!("{}: the output is a FIFO", arg(&sandbox.path(link)))]);
    }
    assert!(links.iter().all(|link| sandbox.path(link).is_symlink()));
    assert!(fs::metadata(&fifo).unwrap().file_type().is_fifo());
    assert_says(&sandbox.refuse("report @room --out /dev/stdout"), &["/dev/stdout: the output is a"]);
    // If the output is a folder of images, this is checked before the first image is rendered.
    fs::create_dir(sandbox.path("views")).unwrap();
    symlink(&fifo, sandbox.path("views/008.png")).unwrap();
    let error = sandbox.refuse("render --splat @room/truth.ply --scene @room --out @views");
    assert_says(&error, &["008.png: the output is a FIFO"]);
    assert_eq!(sandbox.names("views"), ["008.png"]);
}

#[test]
fn two_processes_may_write_the_same() {
    let sandbox = Sandbox::with_weights();
    fs::create_dir(sandbox.path("out")).unwrap();
    for line in [
        "reconstruct --weights @tiny.safetensors --scene @room --out @out/room.ply",
        "render --splat @room/truth.ply --out @out/film.gif --orbit --frames 12 --size 48x48",
        "render --splat @room/truth.ply --out @out/views --orbit --frames 12 --size 48x48",
    ] {
        let started: Vec<_> = (0..4).map(|_| sandbox.command(line).spawn().unwrap()).collect();
        for process in started {
            assert!(process.wait_with_output().unwrap().status.success(), "{line}");
        }
    }
    let files = sandbox.contents();
    assert!(files.keys().all(|file| !arg(file).contains("globalsplat-")), "{:?}", files.keys());
    read_splat(&sandbox.path("out/room.ply")).unwrap();
}

#[test]
fn endings_are_the_same_in_capitals() {
    let sandbox = Sandbox::new();
    let render = "render --splat @room/truth.ply --scene @room --out";
    for (name, magic) in [("film.GIF", &b"GIF89a"[..]), ("row.PNG", b"\x89PNG")] {
        sandbox.run(&format!("{render} @{name}"));
        assert!(sandbox.read(name).starts_with(magic), "{name}");
    }
    assert_says(&sandbox.refuse(&format!("{render} @f.GIF --fps 60")), &["expected 1 to 50 in a .gif"]);
    // With or without an encoder, no folder of that name is created.
    let _ = sandbox.output(&format!("{render} @film.MP4"));
    assert!(!sandbox.path("film.MP4").is_dir());
    sandbox.run("convert @room/truth.ply @room.SPZ");
}

#[test]
fn output_image_names_do_not_collide() {
    let sandbox = Sandbox::new();
    // One photo has the name of another's depth image.
    fs::rename(sandbox.path("room/images/001.png"), sandbox.path("room/images/000_depth.png")).unwrap();
    let cameras = sandbox.text("room/cameras.json").replace("images/001.png", "images/000_depth.png");
    sandbox.write("room/cameras.json", cameras);
    sandbox.run("render --splat @room/truth.ply --scene @room --out @views --depth");
    assert_eq!(sandbox.names("views").len(), 18);
    sandbox.run("render --splat @room/truth.ply --scene @room --out @views");
    assert_eq!(read_image(&sandbox.path("views/000_depth.png")).unwrap().dimensions(), (40, 40));

    // Photos of one name in two folders.
    let rig = sandbox.path("rig");
    write_room(&rig, 3, 6, [32, 32].into());
    let mut cameras = sandbox.text("rig/cameras.json");
    for index in 0..6 {
        let (old, new) = (
            format!("images/{index:03}.png"),
            format!("images/{}/{:03}.png", ["left", "right"][index / 3], index % 3),
        );
        sandbox.copy(&format!("rig/{old}"), &format!("rig/{new}"));
        cameras = cameras.replace(&old, &new);
    }
    sandbox.write("rig/cameras.json", cameras);
    sandbox.run("render --splat @rig/truth.ply --scene @rig --depth --out @out");
    assert!(sandbox.path("out/left/000.png").is_file() && sandbox.path("out/right/002_depth.png").is_file());
    let scores = sandbox.json("eval --renders @out --scene @rig");
    let views = scores["views"].as_array().unwrap();
    assert!(views.len() == 6 && views.iter().all(|view| view["psnr"].as_f64().unwrap() > 45.), "{views:?}");
    assert!(scores.get("gaussians").is_none());
    let error = sandbox.refuse("eval --renders @out/left --scene @rig");
    assert_says(&error, &["the image for left/000 is missing"]);
}

#[test]
fn a_run_keeps_foreign_files() {
    let sandbox = Sandbox::new();
    let files = [
        "run/frames/notes.txt",
        "run/checkpoints/step-1/notes.txt",
        "run/checkpoints/step-00000001-kept/notes.txt",
        // A folder that the run removes later.
        "run/checkpoints/step-00000002/notes.txt",
    ];
    files[..3].iter().for_each(|file| sandbox.write(file, NOTES));
    // Without validation, no checkpoint is the best one.
    let train = "train --config @tiny.toml --out @run --set data.holdout=none --set train.steps";
    sandbox.run(&format!("{train}=2"));
    sandbox.write(files[3], NOTES);
    sandbox.run(&format!("{train}=8"));
    files.iter().for_each(|file| assert_eq!(sandbox.text(file), NOTES, "{file}"));
    assert!(!sandbox.path("run/checkpoints/step-00000002/state.json").exists(), "dropped but for the notes");
    assert_eq!(list_checkpoints(&sandbox.path("run")).unwrap().len(), 2);

    // An incomplete checkpoint is removed.
    sandbox.write("run/checkpoints/step-00000005/model.safetensors", "");
    sandbox.run(&format!("{train}=12"));
    assert!(!sandbox.path("run/checkpoints/step-00000005").exists());
}

#[test]
fn foreign_files_are_not_overwritten() {
    let sandbox = Sandbox::new();
    // `pack` replaces no chunk but one that it would write.
    sandbox.write("chunks/000000.torch", NOTES);
    let error = sandbox.refuse("pack @room --out @chunks");
    assert_says(&error, &["000000.torch: the output is an existing chunk"]);
    assert_eq!(sandbox.text("chunks/000000.torch"), NOTES);
    fs::remove_file(sandbox.path("chunks/000000.torch")).unwrap();
    sandbox.run("pack @room --out @chunks");
    let before = sandbox.read("chunks/000000.torch");
    // Simulates a process that was stopped before it wrote the index.
    fs::remove_file(sandbox.path("chunks/index.json")).unwrap();
    sandbox.run("pack @room --out @chunks");
    assert!(sandbox.read("chunks/000000.torch") == before);

    // A refinement continues no log but its own.
    sandbox.write("log/metrics.jsonl", NOTES);
    let error = sandbox.refuse("refine --scene @room --steps 2 --out @a.ply --log @log");
    assert_says(&error, &["metrics.jsonl: line 1 is no line of a refinement's log"]);
    assert_eq!((sandbox.text("log/metrics.jsonl").as_str(), sandbox.names("log").len()), (NOTES, 1));
    let error = sandbox.refuse("refine --scene @room --steps 2 --out @a.ply --log @room/images");
    assert_says(&error, &["a folder with the capture's photos"]);

    // A run takes no configuration for its own.
    sandbox.copy("tiny.toml", "run/config.toml");
    for _ in 0..2 {
        let error = sandbox.refuse("train --config @run/config.toml --out @run");
        assert_says(&error, &["the run's folder is one with a config.toml that no run wrote"]);
    }
    assert_eq!(sandbox.text("run/config.toml"), sandbox.text("tiny.toml"));
}
