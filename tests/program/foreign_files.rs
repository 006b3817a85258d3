//! Files that the program did not write are kept, and ambiguous ones are refused.
#![cfg(unix)]

use crate::common::program::{arg, refuse, room, succeed, text, tiny_config, train};
use crate::common::room::write_room;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const NOTES: &str = "what somebody wrote";

/// Writes a file that stands for a user's own.
fn put(file: PathBuf) -> PathBuf {
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    std::fs::write(&file, NOTES).unwrap();
    file
}

#[track_caller]
fn assert_kept(file: &Path) {
    assert_eq!(std::fs::read_to_string(file).unwrap(), NOTES, "{}", file.display());
}

/// Returns the contents of every file in `folder`.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.is_dir() {
            true => files.extend(contents(&path)),
            false => drop(files.insert(path.clone(), std::fs::read(&path).unwrap())),
        }
    }
    files
}

#[test]
fn a_run_keeps_foreign_files() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let files = [
        "frames/notes.txt",
        ".notes.old/notes.txt",
        ".best.partial/notes.txt",
        "checkpoints/step-1/notes.txt",
        "checkpoints/step-00000001-kept/notes.txt",
        "checkpoints/.step-00000001.old/notes.txt",
        // Folders that the run replaces and removes later.
        "best/notes.txt",
    ];
    let mut files: Vec<PathBuf> = files.iter().map(|name| put(run.join(name))).collect();
    let train_to = |steps: &str| succeed(&text(&train(&config, &run, &[&format!("train.steps={steps}")])));
    train_to("2");
    files.push(put(run.join("checkpoints/step-00000002/notes.txt")));
    train_to("8");
    files.iter().for_each(|file| assert_kept(file));
    assert!(run.join("best/state.json").is_file());
    assert!(!run.join("checkpoints/step-00000002/state.json").exists(), "dropped but for the notes");
    let kept = globalsplat::train::list_checkpoints(&run).unwrap();
    let whole = kept.iter().filter(|checkpoint| checkpoint.join("state.json").is_file());
    assert_eq!(whole.count(), 2);
}

#[test]
fn broken_checkpoints_do_not_count_as_kept() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let train = |settings: &[&str]| succeed(&text(&train(&config, &run, settings)));
    train(&["train.steps=4", "train.keep_checkpoints=3"]);
    let at = |step: u64| run.join(format!("checkpoints/step-{step:08}"));
    // A checkpoint with a number that the run hasn't reached again, and an incomplete one.
    std::fs::create_dir(at(90)).unwrap();
    std::fs::write(at(90).join("state.json"), "{").unwrap();
    std::fs::write(at(2).join("model.safetensors"), "").unwrap();
    train(&["train.steps=8", "train.keep_checkpoints=2"]);
    let kept = globalsplat::train::list_checkpoints(&run).unwrap();
    assert_eq!(kept, [at(6), at(8), at(90)]);
}

#[test]
fn pack_replaces_no_chunk_but_one_that_it_would_write() {
    let (folder, room) = room();
    let out = folder.path().join("chunks");
    let chunk = put(out.join("000000.torch"));
    let error = refuse(&["pack", arg(&room), "--out", arg(&out)]);
    assert!(error.contains("000000.torch: the output is an existing chunk"), "{error}");
    assert_kept(&chunk);
    std::fs::remove_file(&chunk).unwrap();
    succeed(&["pack", arg(&room), "--out", arg(&out)]);
    // Simulates a process that was stopped before it wrote the index.
    let before = std::fs::read(&chunk).unwrap();
    std::fs::remove_file(out.join("index.json")).unwrap();
    succeed(&["pack", arg(&room), "--out", arg(&out)]);
    assert_eq!(std::fs::read(&chunk).unwrap(), before);
}

#[test]
fn pictures_are_not_put_over_photos() {
    let (_folder, room) = room();
    let before = contents(&room);
    let (splat, images) = (room.join("truth.ply"), room.join("images"));
    let error = refuse(&["render", "--splat", arg(&splat), "--scene", arg(&room), "--out", arg(&images)]);
    assert!(error.contains("000.png: the output is a photo of the capture"), "{error}");
    assert_eq!(contents(&room), before);
}

#[test]
fn a_run_takes_no_configuration_for_its_own() {
    let (folder, room) = room();
    let run = folder.path().join("run");
    std::fs::create_dir(&run).unwrap();
    let config = run.join("config.toml");
    std::fs::rename(tiny_config(folder.path(), &room), &config).unwrap();
    let before = std::fs::read(&config).unwrap();
    let error = refuse(&["train", "--config", arg(&config), "--out", arg(&run)]);
    let again = refuse(&["train", "--config", arg(&config), "--out", arg(&run)]);
    assert_eq!(error, again);
    assert!(error.contains("the run's folder is one with a config.toml that no run wrote"), "{error}");
    assert_eq!(std::fs::read(&config).unwrap(), before);
    // Files that a run wrote are overwritten.
    let other = folder.path().join("other");
    let train = |config: &Path| {
        succeed(&["train", "--config", arg(config), "--out", arg(&other), "--set", "train.steps=1"])
    };
    train(&config);
    train(&other.join("config.toml"));
}

#[test]
fn photos_of_one_name_in_two_folders_have_pictures_of_their_own() {
    let folder = tempfile::tempdir().unwrap();
    let rig = folder.path().join("rig");
    write_room(&rig, 3, 6, [32, 32].into()).unwrap();
    let file = rig.join("cameras.json");
    let mut text = std::fs::read_to_string(&file).unwrap();
    for (index, side) in
        ["left", "right"].iter().flat_map(|side| [(0, side), (1, side), (2, side)]).enumerate()
    {
        let (number, side) = side;
        std::fs::create_dir_all(rig.join("images").join(side)).unwrap();
        let name = format!("images/{side}/{number:03}.png");
        std::fs::rename(rig.join(format!("images/{index:03}.png")), rig.join(&name)).unwrap();
        text = text.replace(&format!("images/{index:03}.png"), &name);
    }
    std::fs::write(&file, text).unwrap();
    let (splat, out) = (rig.join("truth.ply"), folder.path().join("out"));
    succeed(&["render", "--splat", arg(&splat), "--scene", arg(&rig), "--depth", "--out", arg(&out)]);
    assert!(out.join("left/000.png").is_file() && out.join("right/002_depth.png").is_file());
    let scores = succeed(&["eval", "--renders", arg(&out), "--scene", arg(&rig), "--json"]);
    let scores: serde_json::Value = serde_json::from_str(&scores).unwrap();
    let views = scores["views"].as_array().unwrap();
    assert!(views.len() == 6 && views.iter().all(|view| view["psnr"].as_f64().unwrap() > 45.), "{views:?}");
    let flat = folder.path().join("out/left");
    let error = refuse(&["eval", "--renders", arg(&flat), "--scene", arg(&rig)]);
    assert!(error.contains("the image for left/000 is missing"), "{error}");
}
