//! Every command works in a folder whose name isn't UTF-8, and its JSON contains the name as text.
#![cfg(target_os = "linux")]

use crate::common::program::{TINY_CONFIG, command};
use crate::common::room::write_rooms;
use serde_json::{Value, json};
use std::ffi::{OsStr, OsString};
use std::os::unix::ffi::OsStrExt;
use std::path::PathBuf;
use std::process::Command;

/// Name of a folder in Latin-1, and its lossy conversion to text.
const NAME: &[u8] = b"caf\xe9";
const SHOWN: &str = "caf\u{fffd}";

struct Folder(PathBuf);

impl Folder {
    fn path(&self, name: &str) -> OsString {
        self.0.join(name).into()
    }

    /// Returns the command of `line` with this as current folder; words that begin with @ are files there.
    fn command(&self, line: &str) -> Command {
        let mut command = command(&[]);
        command.args(line.split(' ').map(|word| match word.strip_prefix('@') {
            Some(name) => self.path(name),
            None => word.into(),
        }));
        // The command finds no networks for LPIPS and no browser, and its temporary files are in this folder.
        command
            .current_dir(&self.0)
            .env("ROOMS", self.path("rooms"))
            .env("GLOBALSPLAT_WEIGHTS", &self.0)
            .env("TMPDIR", &self.0)
            .env("PATH", "");
        command
    }

    /// Returns the JSON object that the command prints, and asserts that the values of `keys` are paths.
    fn json(&self, line: &str, keys: &[&str]) -> Value {
        let done = self.command(&format!("{line} --json")).output().expect("a program");
        assert!(done.status.success(), "{line}: {}", String::from_utf8_lossy(&done.stderr));
        let report: Value = serde_json::from_slice(&done.stdout).expect("JSON");
        for key in keys {
            let path =
                report.pointer(key).and_then(Value::as_str).unwrap_or_else(|| panic!("{key} of {report}"));
            assert!(path.contains(SHOWN), "{line}: {key} is {path}");
        }
        report
    }
}

#[test]
fn names_that_are_not_utf_8() {
    let outside = tempfile::tempdir().expect("a folder");
    let folder = Folder(outside.path().join(OsStr::from_bytes(NAME)));
    std::fs::create_dir(&folder.0).expect("a folder");
    let write = |name: &str, text: &str| std::fs::write(folder.0.join(name), text).expect("a file");

    write_rooms(&folder.0.join("rooms"), 2, 9, 40).expect("rooms");
    let videos = "synth --out @videos --frames 9 --size 64 --depth --contact-sheet @s.png";
    folder.json(videos, &["/out", "/index", "/depth", "/contact_sheet"]);
    folder.json("pack @rooms --out @chunks", &["/out"]);
    assert_eq!(folder.json("pack @rooms --out chunks_too", &[])["out"], "chunks_too", "as it was given");

    write("tiny.toml", &TINY_CONFIG.replace("[data]", "[data]\ncaptures = [\"${ROOMS}/room_000\"]"));
    folder.json("train --config @tiny.toml --out @run", &["/checkpoint", "/curves"]);
    folder.json("export --run @run --out @tiny.safetensors", &["/weights"]);
    folder.json("import --from @tiny.safetensors --out @imported.safetensors", &["/weights"]);

    for path in [
        "@rooms/room_000",
        "@videos/000000.torch",
        "@chunks/000000.torch#room_001",
        "@tiny.safetensors",
        "@rooms/room_000/truth.ply",
    ] {
        folder.json(&format!("inspect {path}"), &[]);
    }
    std::fs::remove_file(folder.0.join("chunks_too/000000.torch")).expect("a chunk");
    folder.json("inspect @chunks_too", &["/absent_chunks/0"]);

    let splat = "--splat @rooms/room_000/truth.ply --scene @rooms/room_000";
    let model = "reconstruct --weights @tiny.safetensors --out @made.ply --scene @rooms/room_000";
    folder.json(model, &["/splat", "/weights"]);
    let refine = format!("refine --steps 1 --contact-sheet @sheet.png --out @refined.spz {splat}");
    folder.json(&refine, &["/splat"]);
    folder.json("convert @refined.spz @refined.splat", &["/from/splat", "/to/splat"]);
    for out in ["@views", "@orbit.png --orbit --frames 3", "@orbit.gif --orbit --frames 3"] {
        folder.json(&format!("render {splat} --out {out}"), &["/files/0"]);
    }
    folder.json(&format!("bench raster --repeats 1 {splat}"), &[]);

    folder.json(&format!("eval --contact-sheet @scores.png {splat}"), &[]);
    write("index.json", &json!({"room_001": {"context": [0, 2], "target": [1, 3]}}).to_string());
    std::fs::create_dir(folder.0.join("splats")).expect("a folder");
    std::fs::copy(folder.0.join("rooms/room_001/truth.ply"), folder.0.join("splats/room_001.ply"))
        .expect("a copy");
    let eval = "eval --splat @splats --data @rooms --index @index.json --out @scored";
    folder.json(eval, &["/report", "/evaluations/0/folder"]);
    folder.json("report @scored --out @report.html", &["/out", "/evaluations/0/folder"]);
    folder.json("doctor", &[]);

    if !crate::common::has_viewer() {
        return;
    }
    folder.json(&format!("render --html @room.html {splat}"), &["/page"]);
    folder.json("view @rooms/room_000/truth.ply --scene @rooms/room_000", &["/page"]);
}
