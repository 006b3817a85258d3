//! Photos of higher resolution than a model was trained with: `--views-at` and `--pictures-at`.

use crate::common::program::{arg, command, rooms, tiny_weights};
use globalsplat::data::{Capture, Holdout, open_capture};
use globalsplat::eval::read_evaluation;
use globalsplat::reconstruct::{Input, Model, load_context, load_model, reconstruct};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use tch::Device;
use tempfile::TempDir;

/// Room of nine 64×64 photos, with a model of 32×32 images that gets six of them, as every third one is held out.
struct Set {
    folder: TempDir,
    weights: PathBuf,
}

impl Set {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let captures = folder.path().join("captures");
        rooms(&captures, 2, 9, 64);
        let weights = tiny_weights(folder.path(), &captures);
        let frames = json!({"context": [0, 2, 4], "target": [1, 3]});
        let index = json!({"room_000": frames, "room_001": frames});
        std::fs::write(folder.path().join("index.json"), index.to_string()).unwrap();
        Set { folder, weights }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn room(&self) -> PathBuf {
        self.path("captures/room_000")
    }

    fn capture(&self) -> Capture {
        open_capture(&self.room()).unwrap()
    }

    /// Returns the exit code, standard output and standard error of the program, run without LPIPS.
    fn run(&self, arguments: &[&str], options: &[&str]) -> (Option<i32>, String, String) {
        let output = command(&[arguments, options].concat())
            .env("GLOBALSPLAT_WEIGHTS", self.folder.path())
            .output()
            .unwrap();
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        (output.status.code(), text(&output.stdout), text(&output.stderr))
    }

    /// Returns the JSON of `reconstruct`, its messages, and its splat's bytes.
    fn reconstruct(&self, options: &[&str]) -> (Value, String, Vec<u8>) {
        let (room, splat) = (self.room(), self.path("room.ply"));
        let (weights, scene, out) = (arg(&self.weights), arg(&room), arg(&splat));
        let arguments = ["reconstruct", "--weights", weights, "--scene", scene, "--out", out, "--json"];
        let (code, report, err) = self.run(&arguments, options);
        assert_eq!(code, Some(0), "{err}");
        (serde_json::from_str(&report).unwrap(), err, std::fs::read(splat).unwrap())
    }

    /// Returns the JSON of `eval --scene`, and its messages.
    fn score(&self, options: &[&str]) -> (Value, String) {
        let room = self.room();
        let arguments = ["eval", "--weights", arg(&self.weights), "--scene", arg(&room), "--json"];
        let (code, report, err) = self.run(&arguments, options);
        assert_eq!(code, Some(0), "{err}");
        (serde_json::from_str(&report).unwrap(), err)
    }

    /// Runs `eval --data` in the folder `out`.
    fn sweep(&self, out: &str, options: &[&str]) -> (Option<i32>, String, String) {
        let (captures, index, out) = (self.path("captures"), self.path("index.json"), self.path(out));
        let (weights, data) = (arg(&self.weights), arg(&captures));
        let arguments =
            ["eval", "--weights", weights, "--data", data, "--index", arg(&index), "--out", arg(&out)];
        self.run(&arguments, &[options, &["--precision", "f32", "--json"]].concat())
    }

    fn refused(&self, arguments: &[&str], options: &[&str]) -> String {
        let (code, out, err) = self.run(arguments, options);
        assert_eq!((code, out.as_str()), (Some(2), ""), "{err}");
        err.trim().into()
    }
}

fn without_times(mut report: Value) -> Value {
    let times = ["load_seconds", "seconds", "seconds_of", "seconds_from_start", "forward_seconds"];
    for name in times.into_iter().chain(["peak_memory_bytes"]) {
        report.as_object_mut().unwrap().remove(name);
    }
    report
}

#[test]
fn photos_become_as_many_views_as_they_have_phases() {
    let set = Set::new();
    let (report, err, plain) = set.reconstruct(&[]);
    assert_eq!(
        (&report["photos"], &report["views"], &report["image_size"]),
        (&json!(3), &json!(3), &json!([32, 32]))
    );
    assert!(
        err.contains("64×64 pixels are cut and resized to the 32×32 pixels that the model sees"),
        "{err}"
    );

    // At the model's own size, `--views-at` changes nothing.
    let (same, said, bytes) = set.reconstruct(&["--views-at", "32"]);
    assert_eq!((without_times(same), said), (without_times(report), err));
    assert!(bytes == plain, "another splat");

    let (report, err, sharp) = set.reconstruct(&["--views-at", "64"]);
    assert_eq!(
        (&report["photos"], &report["views"], &report["image_size"]),
        (&json!(3), &json!(12), &json!([64, 64]))
    );
    assert_eq!(err.lines().count(), 1, "{err}");
    let expected = "3 of 9 photos are shown, spread over the camera's path; photos are shown as 64×64 pixels, 4 views of the \
                    32×32 pixels that the model sees";
    assert!(err.trim().ends_with(expected), "{err}");
    assert!(sharp.len() == plain.len() && sharp != plain);

    // A higher resolution than that of the photos.
    let (report, err, _) = set.reconstruct(&["--views-at", "96", "--views", "2"]);
    assert_eq!((&report["photos"], &report["views"]), (&json!(2), &json!(18)));
    assert!(err.contains("64×64 pixels are cut and resized to 96×96 pixels, 9 views of"), "{err}");
    assert!(err.trim().ends_with("; smaller photos are enlarged, which shows no more of the scene"), "{err}");
    assert_eq!(err.lines().count(), 1, "{err}");
}

#[test]
fn one_capture_is_scored_in_every_setting() {
    let set = Set::new();
    let (plain, err) = set.score(&[]);
    assert!(!err.contains("photos are"), "{err}");
    assert_eq!(without_times(set.score(&["--views-at", "32"]).0), without_times(plain.clone()));
    let (report, err) = set.score(&["--views-at", "64", "--views-as", "polyphase"]);
    let expected = json!({"photos": 6, "views": 24, "image_size": [64, 64]});
    assert_eq!((&report["input"], &report["image_size"]), (&expected, &json!([32, 32])));
    assert!(report["forward_seconds"].as_f64().unwrap() > 0.);
    assert!(err.starts_with("photos are cut and resized to "), "{err}");
    // The baselines don't depend on the setting.
    assert_eq!(report["baselines"], plain["baselines"]);
    // Scored images of another size are compared with other photos; the splat is the same.
    let (large, _) = set.score(&["--views-at", "64", "--pictures-at", "64"]);
    assert_eq!((&large["input"], &large["image_size"]), (&expected, &json!([64, 64])));
    assert_ne!((&large["psnr"], &large["baselines"]), (&report["psnr"], &report["baselines"]));
    // Small input photos, large scored images.
    let (report, err) = set.score(&["--pictures-at", "128"]);
    assert_eq!((&report["input"]["views"], &report["image_size"]), (&json!(6), &json!([128, 128])));
    assert!(err.starts_with("room_000: smaller photos are enlarged"), "{err}");
    // The size applies to a splat, too.
    let (room, splat) = (set.room(), set.path("captures/room_000/truth.ply"));
    let arguments = ["eval", "--splat", arg(&splat), "--scene", arg(&room), "--json"];
    let [own, half] = [&["--pictures-at", "64"], &["--pictures-at", "32"]].map(|options| {
        let (code, out, err) = set.run(&arguments, options);
        assert_eq!(code, Some(0), "{err}");
        serde_json::from_str::<Value>(&out).unwrap()["psnr"].as_f64().unwrap()
    });
    assert!(own > 50. && half < own, "{own} {half}");
}

#[test]
fn an_evaluation_does_not_resume_at_another_resolution() {
    let set = Set::new();
    assert_eq!(set.sweep("plain", &[]).0, Some(0));
    let plain = read_evaluation(&set.path("plain")).unwrap();
    assert_eq!((plain.input, plain.image_size), (Some(Input::PLAIN), [32, 32]));
    let options = ["--views-at", "64", "--pictures-at", "64"];
    let (code, out, err) = set.sweep("sharp", &options);
    assert_eq!(code, Some(0), "{err}");
    let report: Value = serde_json::from_str(&out).unwrap();
    let report = &report["evaluations"][0];
    assert_eq!(report["input"], json!({"phase": 2}));
    assert_eq!((&report["image_size"], &report["context_views"]), (&json!([64, 64]), &json!(3)));
    let found = read_evaluation(&set.path("sharp")).unwrap();
    assert_eq!(found.method, "tiny polyphase 64");
    let report = std::fs::read_to_string(set.path("sharp").join("report.html")).unwrap();
    assert!(report.contains(&found.method) && report.contains("64×64 pixels"));

    // An unchanged command resumes. Another size of the input or of scored images is refused.
    assert_eq!(set.sweep("sharp", &options).0, Some(0));
    for other in [["--views-at", "96", "--pictures-at", "64"], ["--views-at", "64", "--pictures-at", "32"]] {
        let (code, _, err) = set.sweep("sharp", &other);
        assert!(code == Some(2) && err.contains("evaluation.json: the evaluation is of tiny"), "{err}");
        assert!(err.contains("64×64 pixels") && err.contains("choose another --out"), "{err}");
    }
    let (code, _, err) = set.sweep("small", &["--pictures-at", "64"]);
    assert_eq!(code, Some(0), "{err}");
    let small = read_evaluation(&set.path("small")).unwrap();
    assert_ne!(found.scenes[1].scores.mean.psnr, small.scenes[1].scores.mean.psnr);
    // The model's own size counts as no setting.
    assert_eq!(set.sweep("plain", &["--views-at", "32", "--pictures-at", "32"]).0, Some(0));
    let (code, _, err) = set.sweep("large", &["--pictures-at", "96"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(err.contains("2 of 2 scenes: smaller photos are enlarged"), "{err}");
    assert!(read_evaluation(&set.path("large")).unwrap().scenes.iter().all(|scene| scene.enlarged));
}

/// A photo counts once for the normalization of the scene, however many views it becomes.
#[test]
fn normalization_does_not_depend_on_the_resolution() {
    let set = Set::new();
    let loaded = load_model(&set.weights, Device::Cpu).unwrap();
    let (capture, size) = (set.capture(), loaded.config.data.image_size);
    let targets = [capture.cameras()[1].c2w, capture.cameras()[2].c2w];
    let world = |input: Input| {
        let photos = load_context(&capture, Holdout::None, Some(3), input.photo_size(size)).unwrap();
        let model = Model { input, ..Model::from(&loaded) };
        let made = reconstruct(model, &photos, &targets).unwrap();
        (made.world_from_normalized.translation, made.target_poses)
    };
    let plain = world(Input::PLAIN);
    assert_eq!(world(Input::with_height(64, size).unwrap()), plain);
}

#[test]
fn invalid_resolutions_are_refused() {
    let set = Set::new();
    let (room, out, data) = (set.room(), set.path("room.ply"), set.path("captures"));
    let (weights, scene) = (arg(&set.weights), arg(&room));
    let reconstruct = ["reconstruct", "--weights", weights, "--scene", scene, "--out", arg(&out)];
    let eval = ["eval", "--weights", weights, "--scene", scene];
    let (index, folder) = (set.path("index.json"), set.path("out"));
    let (index, folder) = (arg(&index), arg(&folder));
    let sweep = ["eval", "--weights", weights, "--data", arg(&data), "--index", index, "--out", folder];
    let expected = "globalsplat: --views-at is 50, expected a multiple of the 32 pixels that the model sees, with sides of 16384 \
                    at most: 32, 64, 96, …";
    for command in [&reconstruct[..], &eval, &sweep] {
        assert_eq!(set.refused(command, &["--views-at", "50"]), expected);
        assert!(set.refused(command, &["--views-at", "0"]).contains("--views-at is 0, expected"));
    }
    for command in [&eval[..], &sweep] {
        let expected = "globalsplat: --pictures-at is 8, expected pictures with sides of 11 to 16384 pixels";
        assert_eq!(set.refused(command, &["--pictures-at", "8"]), expected);
        assert!(set.refused(command, &["--views-as", "polyphase"]).contains("--views-at"));
        for removed in ["whole", "repeated"] {
            let error = set.refused(command, &["--views-at", "64", "--views-as", removed]);
            assert!(error.contains("expected polyphase; whole and repeated were removed"), "{error}");
        }
    }
    assert!(
        set.refused(&reconstruct, &["--views-at", "64", "--refine", "1s"]).contains("cannot be used with")
    );
    let splat = set.path("captures/room_000/truth.ply");
    let splat = ["eval", "--splat", arg(&splat), "--scene", scene];
    assert!(set.refused(&splat, &["--views-at", "64"]).contains("cannot be used with"));
    assert!(!Path::new(&out).exists());
}
