//! Outputs replace neither inputs of the command nor anything but regular files.
#![cfg(unix)]

use crate::common::program::{
    arg, command, fail, globalsplat, refuse, room, rooms, succeed, text, tiny_config, tiny_weights, train,
};
use globalsplat::io::{read_image, read_splat};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt, symlink};
use std::path::{Path, PathBuf};

/// Returns every file below `folder`, with its contents.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.is_dir() {
            true => files.extend(contents(&path)),
            false => drop(files.insert(path.clone(), fs::read(&path).unwrap())),
        }
    }
    files
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

/// Folder with a capture, a splat of it, and weights.
struct Captured {
    folder: tempfile::TempDir,
    room: PathBuf,
    splat: PathBuf,
    weights: PathBuf,
}

impl Captured {
    fn new() -> Self {
        let (folder, room) = room();
        let splat = folder.path().join("splat.ply");
        fs::copy(room.join("truth.ply"), &splat).unwrap();
        let weights = tiny_weights(folder.path(), &room);
        Captured { folder, room, splat, weights }
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }
}

/// Runs every command of `requests` and asserts that it is refused because its output is an input, and that nothing changed in
/// `folder`.
#[track_caller]
fn refuse_all(folder: &Path, requests: &[&[&str]]) {
    let before = contents(folder);
    for request in requests {
        let error = refuse(request);
        assert!(
            [
                "a photo of the capture",
                "a file that this command reads",
                "a folder with the capture's photos"
            ]
            .iter()
            .any(|found| error.contains(&format!("the output is {found}"))),
            "{request:?}: {error}"
        );
        assert!(contents(folder) == before, "{request:?} changed a file");
    }
}

#[test]
fn pictures_replace_nothing_that_is_read() {
    let files = Captured::new();
    let (room, images, photo) = (&files.room, files.room.join("images"), files.room.join("images/000.png"));
    let (link, hard, linked) = (files.at("link.png"), files.at("hard.png"), files.at("linked"));
    symlink(&photo, &link).unwrap();
    fs::hard_link(&photo, &hard).unwrap();
    symlink(&images, &linked).unwrap();
    // Links to photos, named like the output files, in a folder below the output.
    let below = files.at("below");
    fs::create_dir(&below).unwrap();
    symlink(&photo, below.join("000.png")).unwrap();
    let camera_path = files.at("path.json.png");
    fs::copy(room.join("cameras.json"), files.at("cameras.json")).unwrap();
    symlink(files.at("path.json"), &camera_path).unwrap();
    let pose: Vec<f64> = (0..16).map(|i| f64::from(u8::from(i % 5 == 0))).collect();
    let camera = json!({"camera_to_world": pose, "fov": 60});
    let path = json!({"camera_path": [camera], "render_height": 24, "render_width": 24});
    fs::write(files.at("path.json"), path.to_string()).unwrap();
    let [room, images, photo, splat, weights] =
        [room, &images, &photo, &files.splat, &files.weights].map(|path| arg(path));
    let [link, hard, linked, below] = [&link, &hard, &linked, &below].map(|path| arg(path));
    let viewer = files.at("path.json");
    let render = ["render", "--splat", splat];
    refuse_all(
        files.folder.path(),
        &[
            &[&render[..], &["--path", room, "--out", images]].concat(),
            &[&render[..], &["--path", room, "--out", linked]].concat(),
            &[&render[..], &["--path", room, "--out", below]].concat(),
            &[&render[..], &["--path", room, "--frames", "3", "--out", images]].concat(),
            &[&render[..], &["--path", room, "--out", photo]].concat(),
            &[&render[..], &["--path", room, "--out", link]].concat(),
            &[&render[..], &["--path", room, "--out", hard]].concat(),
            &[&render[..], &["--path", arg(&viewer), "--out", arg(&camera_path)]].concat(),
            &[&render[..], &["--scene", room, "--out", images]].concat(),
            &[&render[..], &["--scene", room, "--orbit", "--frames", "3", "--out", images]].concat(),
            &[&render[..], &["--scene", room, "--depth", "--out", photo]].concat(),
            &["render", "--weights", weights, "--scene", room, "--out", images],
            &["eval", "--splat", splat, "--scene", room, "--contact-sheet", photo],
            &["eval", "--splat", splat, "--scene", room, "--contact-sheet", link],
            &["eval", "--weights", weights, "--scene", room, "--contact-sheet", hard],
            &[
                "refine",
                "--splat",
                splat,
                "--scene",
                room,
                "--steps",
                "1",
                "--out",
                splat,
                "--contact-sheet",
                photo,
            ],
            &["synth", "--out", arg(&files.at("worlds")), "--pictures", images, "--contact-sheet", photo],
            &["synth", "--out", images, "--pictures", images],
        ],
    );
}

#[test]
fn splats_and_weights_replace_nothing_that_is_read() {
    let files = Captured::new();
    let cameras = files.room.join("cameras.json");
    let (as_splat, as_weights, as_page) =
        (files.at("cameras.ply"), files.at("config.ply"), files.at("page.html"));
    symlink(&cameras, &as_splat).unwrap();
    symlink(&files.weights, &as_weights).unwrap();
    symlink(&files.splat, &as_page).unwrap();
    let config = tiny_config(files.folder.path(), &files.room);
    let run = files.at("run");
    succeed(&text(&train(&config, &run, &["train.steps=2"])));
    let checkpoint = run.join("checkpoints/step-00000002/model.safetensors");
    let [room, splat, weights, config] = [&files.room, &files.splat, &files.weights, &config].map(|p| arg(p));
    let [as_splat, as_weights] = [&as_splat, &as_weights].map(|p| arg(p));
    let made = ["reconstruct", "--weights", weights, "--scene", room];
    refuse_all(
        files.folder.path(),
        &[
            &[&made[..], &["--out", as_splat]].concat(),
            &[&made[..], &["--out", as_weights]].concat(),
            &[&made[..], &["--refine", "1s", "--out", as_weights]].concat(),
            &["refine", "--scene", room, "--steps", "1", "--out", as_splat],
            &["convert", splat, as_splat, "--scene", room],
            &["export", "--config", config, "--out", config],
            &["export", "--run", arg(&run), "--out", arg(&checkpoint)],
            &["export", "--run", arg(&run), "--out", arg(&run.join("config.toml"))],
            &["import", "--from", weights, "--out", weights],
        ],
    );
    if Path::new(env!("CARGO_MANIFEST_DIR")).join("web/dist/page.js").exists() {
        let page = ["render", "--splat", splat, "--scene", room, "--html", arg(&as_page)];
        refuse_all(files.folder.path(), &[&page]);
    }
    // The input splat may be replaced: it is read before.
    succeed(&["convert", splat, splat, "--sh-degree", "0"]);
    assert_eq!(read_splat(&files.splat).unwrap().sh_degree, 0);
    let id = |path: &Path| fs::metadata(path).unwrap().ino();
    let before = id(&files.splat);
    succeed(&["refine", "--splat", splat, "--scene", room, "--steps", "2", "--out", splat]);
    assert!(id(&files.splat) != before);
    // New files beside the photos, and beside a run's files, are allowed.
    succeed(&["convert", splat, arg(&files.room.join("mine.ply"))]);
    succeed(&["export", "--run", arg(&run), "--out", arg(&run.join("model.safetensors"))]);
    succeed(&["export", "--run", arg(&run), "--out", arg(&run.join("model.safetensors"))]);
}

#[test]
fn folders_of_outputs_replace_nothing_that_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    rooms(&data, 2, 9, 40);
    let (room, images) = (data.join("room_000"), data.join("room_000/images"));
    let weights = tiny_weights(folder.path(), &room);
    let config = tiny_config(folder.path(), &room);
    let frames = json!({"context": [0, 2, 4], "target": [1, 3]});
    let put = |name: &str| {
        let file = folder.path().join(name);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(&file, json!({"room_000": frames, "room_001": frames}).to_string()).unwrap();
        file
    };
    let index = put("index.json");
    let sweep = |index: &Path, more: &[&str]| -> Vec<String> {
        let all = ["eval", "--data", arg(&data), "--index", arg(index)];
        all.iter().chain(more).map(|word| word.to_string()).collect()
    };
    // Indices, splats and images at the paths of the outputs.
    let (scored, splats, renders) =
        ("scored/scores.json", folder.path().join("splats"), folder.path().join("renders"));
    let scored = put(scored);
    fs::create_dir(&splats).unwrap();
    for scene in ["room_000", "room_001"] {
        let splat = splats.join(format!("{scene}.ply"));
        fs::copy(data.join(scene).join("truth.ply"), &splat).unwrap();
        let pictures = renders.join(scene);
        fs::create_dir_all(&pictures).unwrap();
        for frame in ["001", "003"] {
            fs::copy(
                data.join(scene).join(format!("images/{frame}.png")),
                pictures.join(format!("{frame}.png")),
            )
            .unwrap();
        }
    }
    let of_renders = folder.path().join("of_renders");
    fs::create_dir_all(of_renders.join("scenes")).unwrap();
    symlink(renders.join("room_000/001.png"), of_renders.join("scenes/room_000.jpg")).unwrap();
    let requests = [
        sweep(&index, &["--weights", arg(&weights), "--out", arg(&images)]),
        sweep(&scored, &["--splat", arg(&splats), "--out", arg(scored.parent().unwrap())]),
        sweep(&index, &["--renders", arg(&renders), "--out", arg(&of_renders)]),
        vec!["pack".into(), arg(&room).into(), "--out".into(), arg(&images).into()],
        train(&config, &images, &[]),
    ];
    let requests: Vec<Vec<&str>> = requests.iter().map(|request| text(request)).collect();
    let requests: Vec<&[&str]> = requests.iter().map(Vec::as_slice).collect();
    // Folders that the commands create before the check are not files.
    refuse_all(folder.path(), &requests);

    // A report may be written beside the scores that it shows, but must not replace them.
    let out = folder.path().join("out");
    succeed(&text(&sweep(&index, &["--splat", arg(&splats), "--out", arg(&out)])));
    for name in ["scores.json", "evaluation.json", "scenes/room_000.jpg"] {
        refuse_all(folder.path(), &[&["report", arg(&out), "--out", arg(&out.join(name))]]);
    }
    succeed(&["report", arg(&out), "--out", arg(&out.join("report.html"))]);
    // An evaluation that is repeated resumes on its own files, also in a folder of the dataset.
    let within = room.join("scores");
    for _ in 0..2 {
        succeed(&text(&sweep(&index, &["--splat", arg(&splats), "--out", arg(&within)])));
    }
    // A run may be trained with its own configuration.
    let run = folder.path().join("run");
    succeed(&text(&train(&config, &run, &["train.steps=2"])));
    succeed(&text(&train(&run.join("config.toml"), &run, &["train.steps=3"])));
}

#[test]
fn links_are_followed_and_special_files_refused() {
    let files = Captured::new();
    let [room, splat] = [&files.room, &files.splat].map(|path| arg(path));
    let (config, fifo) = (tiny_config(files.folder.path(), &files.room), files.at("fifo"));
    let name = std::ffi::CString::new(arg(&fifo)).unwrap();
    assert_eq!(unsafe { libc::mkfifo(name.as_ptr(), 0o600) }, 0);
    for (ending, request) in [
        ("ply", vec!["convert", splat]),
        ("ply", vec!["refine", "--scene", room, "--steps", "1", "--out"]),
        ("ply", vec!["reconstruct", "--scene", room, "--out"]),
        ("png", vec!["render", "--splat", splat, "--scene", room, "--out"]),
        ("gif", vec!["render", "--splat", splat, "--scene", room, "--out"]),
        ("", vec!["render", "--splat", splat, "--scene", room, "--out"]),
        ("png", vec!["eval", "--splat", splat, "--scene", room, "--contact-sheet"]),
        ("safetensors", vec!["export", "--config", arg(&config), "--out"]),
        ("", vec!["pack", room, "--out"]),
        ("", vec!["synth", "--out"]),
        ("", vec!["train", "--config", arg(&config), "--out"]),
    ] {
        for (target, found) in [(fifo.as_path(), "a FIFO"), (Path::new("/dev/null"), "a device")] {
            let link = files.at("link").with_extension(ending);
            symlink(target, &link).unwrap();
            let error = refuse(&[&request[..], &[arg(&link)]].concat());
            assert!(
                error.contains(&format!("{}: the output is {found}", link.display())),
                "{request:?}: {error}"
            );
            assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
            fs::remove_file(link).unwrap();
        }
    }
    assert!(fs::metadata(&fifo).unwrap().file_type().is_fifo());
    assert!(refuse(&["report", room, "--out", "/dev/stdout"]).contains("/dev/stdout: the output is a"));

    // The target of a symbolic link is replaced, or created.
    fs::create_dir(files.at("below")).unwrap();
    for target in ["below/there.spz", "below/new.spz"] {
        let link = files.at("link.spz");
        symlink(target, &link).unwrap();
        if target.contains("there") {
            fs::write(files.at(target), "old").unwrap();
        }
        succeed(&["convert", splat, arg(&link)]);
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
        read_splat(&files.at(target)).unwrap();
        fs::remove_file(link).unwrap();
    }
    assert_eq!(names(&files.at("below")), ["new.spz", "there.spz"]);
    // If the output is a folder of images, this is checked before the first image is rendered.
    let views = files.at("views");
    fs::create_dir(&views).unwrap();
    symlink(&fifo, views.join("008.png")).unwrap();
    let error = refuse(&["render", "--splat", splat, "--scene", room, "--out", arg(&views)]);
    assert!(error.contains("008.png: the output is a FIFO"), "{error}");
    assert_eq!(names(&views), ["008.png"]);
}

#[test]
fn two_processes_may_write_the_same() {
    let files = Captured::new();
    let [room, splat, weights] = [&files.room, &files.splat, &files.weights].map(|path| arg(path));
    let out = files.at("out");
    fs::create_dir(&out).unwrap();
    let [ply, film, views] = ["room.ply", "film.gif", "views"].map(|name| out.join(name));
    let orbit = ["--orbit", "--frames", "12", "--size", "48x48"];
    for request in [
        vec!["reconstruct", "--weights", weights, "--scene", room, "--out", arg(&ply)],
        [&["render", "--splat", splat, "--out", arg(&film)][..], &orbit].concat(),
        [&["render", "--splat", splat, "--out", arg(&views)][..], &orbit].concat(),
    ] {
        for _ in 0..3 {
            let begun: Vec<_> = (0..4).map(|_| command(&request).spawn().unwrap()).collect();
            for process in begun {
                assert!(process.wait_with_output().unwrap().status.success(), "{request:?}");
            }
        }
        assert!(
            contents(&out).keys().all(|file| !arg(file).contains("globalsplat-")),
            "{:?}",
            contents(&out).keys()
        );
    }
    read_splat(&ply).unwrap();
}

#[test]
fn long_names_and_files_of_killed_processes_cause_no_errors() {
    let files = Captured::new();
    let [room, splat] = [&files.room, &files.splat].map(|path| arg(path));
    let long = |ending: &str| files.at("out").join(format!("{}{ending}", "x".repeat(255 - ending.len())));
    fs::create_dir(files.at("out")).unwrap();
    succeed(&["convert", splat, arg(&long(".spz"))]);
    succeed(&["render", "--splat", splat, "--scene", room, "--out", arg(&long(".png"))]);
    succeed(&["render", "--splat", splat, "--scene", room, "--out", arg(&long(".gif"))]);
    assert_eq!(names(&files.at("out")).len(), 3);
    let too_long = files.at("out").join(format!("{}.ply", "x".repeat(252)));
    refuse(&["reconstruct", "--scene", room, "--out", arg(&too_long)]);
    for name in [".room.ply.globalsplat-partial", ".room.ply.globalsplat-partial-1"] {
        fs::write(files.at("out").join(name), "left").unwrap();
    }
    succeed(&["convert", splat, arg(&files.at("out/room.ply"))]);
    assert!(names(&files.at("out")).iter().all(|name| !name.starts_with('.')));
}

#[test]
fn endings_are_the_same_in_capitals() {
    let files = Captured::new();
    let [room, splat] = [&files.room, &files.splat].map(|path| arg(path));
    let render = |name: &str| {
        let out = files.at(name);
        succeed(&["render", "--splat", splat, "--scene", room, "--out", arg(&out)]);
        assert!(out.is_file(), "{name}");
        fs::read(out).unwrap()
    };
    assert!(render("film.GIF").starts_with(b"GIF89a"));
    assert!(render("Film.Gif").starts_with(b"GIF89a"));
    assert!(render("row.PNG").starts_with(b"\x89PNG"));
    let error = globalsplat(&[
        "render",
        "--splat",
        splat,
        "--scene",
        room,
        "--fps",
        "60",
        "--out",
        arg(&files.at("f.GIF")),
    ]);
    assert!(String::from_utf8_lossy(&error.stderr).contains("expected 1 to 50 in a .gif"));
    // With or without an encoder, no folder of that name is created.
    let _ = globalsplat(&["render", "--splat", splat, "--scene", room, "--out", arg(&files.at("film.MP4"))]);
    assert!(!files.at("film.MP4").is_dir());
    succeed(&["convert", splat, arg(&files.at("room.SPZ"))]);
}

#[test]
fn output_image_names_do_not_collide() {
    let (folder, room) = room();
    // One photo has the name of another's depth image.
    fs::rename(room.join("images/001.png"), room.join("images/000_depth.png")).unwrap();
    let cameras = fs::read_to_string(room.join("cameras.json")).unwrap();
    fs::write(room.join("cameras.json"), cameras.replace("images/001.png", "images/000_depth.png")).unwrap();
    let out = folder.path().join("views");
    let render =
        ["render", "--splat", arg(&room.join("truth.ply")), "--scene", arg(&room), "--out", arg(&out)]
            .map(String::from);
    let report = succeed(&[&text(&render)[..], &["--depth", "--json"]].concat());
    let files = serde_json::from_str::<Value>(&report).unwrap()["files"].as_array().unwrap().len();
    assert_eq!((files, names(&out).len()), (18, 18));
    succeed(&text(&render));
    assert_eq!(read_image(&out.join("000_depth.png")).unwrap().dimensions(), (40, 40));
}

#[test]
fn synth_finishes_after_an_interruption_before_its_indices() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("worlds");
    let synth =
        ["synth", "--out", arg(&out), "--scenes", "2", "--frames", "3", "--size", "16"].map(String::from);
    // A folder at the path of a file stops the program, as a full disk would.
    let index = out.join("evaluation_index.json");
    fs::create_dir_all(index.join("below")).unwrap();
    let error = globalsplat(&text(&synth));
    assert!(!error.status.success());
    fs::remove_dir_all(&index).unwrap();
    succeed(&text(&synth));
    assert_eq!(names(&out), ["000000.torch", "evaluation_index.json", "index.json"]);
}

#[test]
fn checkpoints_that_list_no_files_or_others_are_broken() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    succeed(&text(&train(&config, &run, &["train.steps=4"])));
    let state = run.join("checkpoints/step-00000004/state.json");
    let whole = fs::read_to_string(&state).unwrap();
    let mut value: Value = serde_json::from_str(&whole).unwrap();
    let files = value["files"].as_object().unwrap().clone();
    let outside = files.iter().map(|(name, sums)| (format!("../step-00000004/{name}"), sums.clone()));
    let absolute = files
        .iter()
        .map(|(name, sums)| (format!("{}/{name}", state.parent().unwrap().display()), sums.clone()));
    let fewer = files.clone().into_iter().take(1);
    let more = files.clone().into_iter().chain([("../../config.toml".to_string(), json!([0, 0]))]);
    for names in [
        Value::from(serde_json::Map::new()),
        outside.collect(),
        absolute.collect(),
        fewer.collect(),
        more.collect(),
    ] {
        value["files"] = names;
        fs::write(&state, value.to_string()).unwrap();
        let weights = folder.path().join("weights.safetensors");
        let error = fail(&["export", "--run", arg(&run), "--out", arg(&weights)], 2);
        assert!(error.contains("state.json: the names in files is"), "{error}");
        // The previous checkpoint is loaded.
        let output = globalsplat(&text(&train(&config, &run, &["train.steps=4"])));
        let message = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && message.contains("the previous checkpoint is used"), "{message}");
        assert_eq!(
            serde_json::from_str::<Value>(&fs::read_to_string(&state).unwrap()).unwrap()["files"].as_object(),
            Some(&files)
        );
    }
}

#[test]
fn replaced_files_keep_their_permissions() {
    let files = Captured::new();
    let out = files.at("private.ply");
    fs::write(&out, "").unwrap();
    fs::set_permissions(&out, fs::Permissions::from_mode(0o600)).unwrap();
    succeed(&["convert", arg(&files.splat), arg(&out)]);
    assert_eq!(fs::metadata(&out).unwrap().permissions().mode() & 0o777, 0o600);
}
