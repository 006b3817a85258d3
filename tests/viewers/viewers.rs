//! Our splats in third-party viewers: renders by Spark and Babylon.js, two independent public viewers, in a browser.

use crate::common::browser::Browser;
use crate::common::program::{arg, succeed};
use crate::common::{captures, skip};
use crate::{LEAST, assert_like, own_picture, picture_from_base64};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use globalsplat::data::open_capture;
use globalsplat::io::{Splat, read_splat};
use globalsplat::scene::{Camera, Gaussians, ImageSize};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;
use tch::{Kind, Tensor};

const SIZE: ImageSize = ImageSize { width: 512, height: 512 };

/// Returns the pages with the viewers, by their names.
fn viewers(folder: &Path) -> Option<Vec<(&'static str, PathBuf)>> {
    let npm = Path::new(env!("CARGO_MANIFEST_DIR")).join("parity/npm");
    let bundler = npm.join("node_modules/.bin/esbuild");
    if !bundler.exists() {
        let why = "parity/npm has no packages; install Node.js 20 or newer with npm and run make venv";
        skip("other viewers", why);
        return None;
    }
    let page = |name| {
        let (script, page) = (folder.join(format!("{name}.js")), folder.join(format!("{name}.html")));
        let bundled = Command::new(&bundler)
            .args(["--bundle", "--format=iife", "--log-level=error"])
            .args([format!("--outfile={}", script.display()), format!("viewers/{name}.js")])
            .current_dir(&npm)
            .status();
        assert!(bundled.expect("esbuild").success());
        let text = format!("<!doctype html><meta charset=utf-8><body><script src={name}.js></script>");
        std::fs::write(&page, text).expect("a page");
        (name, page)
    };
    Some(["spark", "babylon"].map(page).into())
}

/// Returns the first camera of a capture, for an image of [`SIZE`].
fn first_camera(capture: &Path) -> Camera {
    open_capture(capture).unwrap().cameras()[0].with_size(SIZE)
}

/// Shows a splat in a viewer; returns the viewer's report, and its image [3, H, W].
fn show(browser: &mut Browser, page: &Path, file: &Path, camera: &Camera) -> (Value, Tensor) {
    browser.open(page);
    let c2w: Vec<f64> = (0..12).map(|i| camera.c2w.col(i % 4)[i / 4]).collect();
    let k = camera.intrinsics;
    let angle = 2. * (f64::from(camera.height) / 2. / k.fy).atan();
    let (width, height) = (camera.width, camera.height);
    let camera = json!({"c2w": c2w, "angle": angle, "aspect": k.fy / k.fx, "width": width, "height": height});
    let bytes = STANDARD.encode(std::fs::read(file).unwrap());
    let ending = file.extension().unwrap().to_str().unwrap();
    let report = browser.evaluate(&format!(
        "show(Uint8Array.from(atob({bytes:?}), (letter) => letter.charCodeAt(0)), {ending:?}, {camera})"
    ));
    assert!(browser.errors().is_empty(), "{:?}", browser.errors());
    let png = report["png"].as_str().unwrap().strip_prefix("data:image/png;base64,").unwrap();
    let picture = picture_from_base64(png);
    (report, picture)
}

/// Returns the corners of the bounding box of the means.
fn bounds(splat: &Splat) -> [Vec<f64>; 2] {
    let means = Gaussians::from_splat(splat).means.view([-1, 3]).to_kind(Kind::Double);
    [means.amin([0i64].as_slice(), false), means.amax([0i64].as_slice(), false)]
        .map(|corner| Vec::try_from(corner).unwrap())
}

#[test]
#[ignore = "make test-all: starts a browser and bundles two viewers"]
fn public_viewers_show_our_splats_as_we_do() {
    let Some(capture) = captures().map(|mut captures| captures.swap_remove(0)) else { return };
    let folder = tempfile::tempdir().unwrap();
    let Some(viewers) = viewers(folder.path()) else { return };
    let Some(mut browser) = Browser::start() else { return };
    let of = |name: &str| folder.path().join(name);
    let published = capture.join("reference.ply");
    // The embedded model's reconstruction, unchanged; and the published splat, whose colors are far beyond the range of a
    // byte, converted by `convert --clamp-sh`. Spark reads SPZ up to version 3, and no glTF.
    succeed(&["reconstruct", "--scene", arg(&capture), "--out", arg(&of("made.ply"))]);
    for name in ["made.spz", "made.sog", "made.glb"] {
        let (from, to) = (of("made.ply"), of(name));
        succeed(&["convert", arg(&from), arg(&to), "--scene", arg(&capture), "--spz-version", "3"]);
    }
    for name in ["published.ply", "published.spz", "published-4.spz", "published.sog", "published.glb"] {
        let (to, version) = (of(name), if name.ends_with("-4.spz") { "4" } else { "3" });
        let (scene, version) = (["--scene", arg(&capture)], ["--spz-version", version]);
        let command = ["convert", arg(&published), arg(&to), "--clamp-sh"];
        succeed(&[&command[..], &scene, &version].concat());
    }
    let (both, babylon) = (&["spark", "babylon"][..], &["babylon"][..]);
    let camera = first_camera(&capture);
    let files = [
        ("made", of("made.ply"), of("made.ply"), LEAST, both),
        ("made", of("made.ply"), of("made.spz"), LEAST, both),
        ("made", of("made.ply"), of("made.sog"), LEAST, both),
        ("made", of("made.ply"), of("made.glb"), LEAST, babylon),
        ("published", published.clone(), of("published.ply"), LEAST, both),
        ("published", published.clone(), of("published.spz"), LEAST, both),
        ("published, version 4", published.clone(), of("published-4.spz"), LEAST, babylon),
        ("published", published.clone(), of("published.sog"), LEAST, both),
        ("published", published.clone(), of("published.glb"), LEAST, babylon),
        // The viewers clamp its colors, each in its own way, so its PSNR is only printed.
        ("as it is", published.clone(), published, 0., both),
    ];
    for (name, original, file, least, readers) in files {
        let splat = read_splat(&original).unwrap();
        let own = own_picture(&splat, camera);
        let ending = file.extension().unwrap().to_str().unwrap();
        for (viewer, page) in viewers.iter().filter(|(viewer, _)| readers.contains(viewer)) {
            let what = format!("{name}, .{ending}, in {viewer}");
            let (report, picture) = show(&mut browser, page, &file, &camera);
            assert_eq!(report["count"].as_i64(), Some(splat.len() as i64), "{what}");
            for (corner, own) in ["low", "high"].iter().zip(bounds(&splat)) {
                let found: Vec<f64> = serde_json::from_value(report[*corner].clone()).unwrap();
                // Spark stores means in half precision.
                for (a, b) in found.iter().zip(own) {
                    assert!((a - b).abs() <= 1e-3 * b.abs(), "{what}: {corner} {a}, {b}");
                }
            }
            assert_like(&what, &picture, &own, least);
        }
    }
}
