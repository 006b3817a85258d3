//! Every command works in a folder whose name isn't UTF-8, and its JSON contains the name as text.
#![cfg(target_os = "linux")]

use crate::common::program::{Sandbox, TINY_CONFIG, run_process};
use crate::common::room::write_rooms;
use serde_json::{Value, json};
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;

/// Name of a folder in Latin-1, and its lossy conversion to text.
const NAME: &[u8] = b"caf\xe9";
const SHOWN: &str = "caf\u{fffd}";

#[test]
fn names_that_are_not_utf_8() {
    let sandbox = Sandbox::named(OsStr::from_bytes(NAME));
    // Returns the JSON object that a command prints, and asserts that the values of `keys` are paths.
    let run_json = |line: &str, keys: &[&str]| {
        let mut command = sandbox.command(&format!("{line} --json"));
        // The command finds no browser, and its temporary files are in this folder.
        command.current_dir(sandbox.folder()).env("TMPDIR", sandbox.folder()).env("PATH", "");
        let (out, _) = run_process(command.env("ROOMS", sandbox.path("rooms")));
        let report: Value = serde_json::from_str(&out).expect("JSON");
        for key in keys {
            let path = report.pointer(key).and_then(Value::as_str).expect(key);
            assert!(path.contains(SHOWN), "{line}: {key} is {path}");
        }
        report
    };

    write_rooms(&sandbox.path("rooms"), 2, 9, 40);
    let videos = "synth --out @videos --frames 9 --size 64 --depth --contact-sheet @s.png";
    run_json(videos, &["/out", "/index", "/depth", "/contact_sheet"]);
    run_json("pack @rooms --out @chunks", &["/out"]);
    assert_eq!(run_json("pack @rooms --out chunks_too", &[])["out"], "chunks_too", "as it was given");

    sandbox.write("tiny.toml", TINY_CONFIG.replace("[data]", "[data]\ncaptures = [\"${ROOMS}/room_000\"]"));
    run_json("train --config @tiny.toml --out @run", &["/checkpoint"]);
    run_json("export --run @run --out @tiny.safetensors", &["/weights"]);
    run_json("import --from @tiny.safetensors --out @imported.safetensors", &["/weights"]);

    for path in [
        "@rooms/room_000",
        "@videos/000000.torch",
        "@chunks/000000.torch#room_001",
        "@tiny.safetensors",
        "@rooms/room_000/truth.ply",
    ] {
        run_json(&format!("inspect {path}"), &[]);
    }
    std::fs::remove_file(sandbox.path("chunks_too/000000.torch")).expect("a chunk");
    run_json("inspect @chunks_too", &["/absent_chunks/0"]);

    let splat = "--splat @rooms/room_000/truth.ply --scene @rooms/room_000";
    let model = "reconstruct --weights @tiny.safetensors --out @made.ply --scene @rooms/room_000";
    run_json(model, &["/splat", "/weights"]);
    let refine = format!("refine --steps 1 --contact-sheet @sheet.png --out @refined.spz {splat}");
    run_json(&refine, &["/splat"]);
    run_json("convert @refined.spz @refined.splat", &["/from/splat", "/to/splat"]);
    for out in ["@views", "@orbit.png --orbit --frames 3", "@orbit.gif --orbit --frames 3"] {
        run_json(&format!("render {splat} --out {out}"), &["/files/0"]);
    }
    run_json(&format!("bench raster --repeats 1 {splat}"), &[]);

    run_json(&format!("eval --contact-sheet @scores.png {splat}"), &[]);
    sandbox.write("index.json", json!({"room_001": {"context": [0, 2], "target": [1, 3]}}).to_string());
    sandbox.copy("rooms/room_001/truth.ply", "splats/room_001.ply");
    let eval = "eval --splat @splats --data @rooms --index @index.json --out @scored";
    run_json(eval, &["/report", "/evaluations/0/folder"]);
    run_json("report @scored --out @report.html", &["/out", "/evaluations/0/folder"]);
    run_json("doctor", &[]);

    if !crate::common::has_viewer() {
        return;
    }
    run_json(&format!("render --html @room.html {splat}"), &["/page"]);
    run_json("view @rooms/room_000/truth.ply --scene @rooms/room_000", &["/page"]);
}
