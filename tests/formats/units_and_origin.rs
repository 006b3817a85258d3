//! Units and origins of captures don't matter: renders are the same in millimetres and kilometres, at the origin and in UTM
//! coordinates, and bit-identical if the unit changes by a power of two (spec 2.5).

use crate::common::program::{Sandbox, assert_says, number};
use crate::common::{has_viewer, pictures, psnr};
use glam::{DMat3, DMat4, DVec3};
use globalsplat::data::{open_capture, write_cameras_json};
use globalsplat::io::{Splat, WriteOptions, origin_file, read_splat, write_local_splat};
use globalsplat::render::{SplatRenderer, move_cameras, transform};
use globalsplat::scene::{Gaussians, LocalFrame, Similarity};
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

/// Scales and origins, among them kilometres, UTM and ECEF coordinates.
const PLACES: [(f64, [f64; 3]); 4] =
    [(1e-6, [0.; 3]), (37., [-4., 3., 5.]), (1., [448_265.12, 5_411_920.65, 135.4]), (1e3, [1e8, -1e8, 1e8])];

/// Returns the similarity transform of such a scale and origin.
fn to_place((scale, offset): (f64, [f64; 3])) -> Similarity {
    Similarity { rotation: DMat3::IDENTITY, translation: DVec3::from_array(offset), scale }
}

/// Writes the capture at `from`, transformed by `to`, to `folder`.
fn write_moved(from: &Path, folder: &Path, to: &Similarity) {
    let capture = open_capture(from).unwrap();
    let names: Vec<String> = capture.names().map(String::from).collect();
    for name in &names {
        fs::create_dir_all(folder.join(name).parent().unwrap()).unwrap();
        fs::copy(from.join(name), folder.join(name)).unwrap();
    }
    let matrix = DMat4::from_mat3_translation(to.rotation * to.scale, to.translation);
    let cameras = move_cameras(&capture.cameras(), &matrix);
    write_cameras_json(&folder.join("cameras.json"), &names, &cameras).unwrap();
}

/// Returns `splat` transformed by `to`, to match a capture transformed by `to`. Its origin is the translation.
fn moved_splat(splat: &Splat, to: &Similarity) -> Splat {
    let about_origin = Similarity { translation: DVec3::ZERO, ..*to };
    transform(&Gaussians::from_splat(splat), &about_origin).to_splat(to.translation).unwrap()
}

/// Returns the minimum PSNR of the PNGs of folder `a` compared with those of `b`.
fn least_psnr(a: &Path, b: &Path) -> f64 {
    let (a, b) = (pictures(a), pictures(b));
    assert!(!a.is_empty() && a.len() == b.len());
    a.iter().zip(&b).map(|(a, b)| psnr(a, b)).fold(f64::INFINITY, f64::min)
}

/// Renders `splat` from the cameras of `scene`, along a smooth path through them and on orbits, to `pictures`. Returns the PSNR of the
/// splat, and that of a copy with losses, which `convert` tells.
fn render_and_score(sandbox: &Sandbox, splat: &str, scene: &str, pictures: &str) -> [f64; 2] {
    sandbox.succeed(&format!("render --splat @{splat} --scene @{scene} --depth --out @{pictures}"));
    for (name, cameras) in [
        ("around", "--orbit".to_string()),
        ("amid", format!("--orbit --scene @{scene}")),
        ("path", format!("--path @{scene}")),
    ] {
        let out = format!("--frames 3 --size 32x24 --out @{pictures}/{name}.png");
        sandbox.succeed(&format!("render --splat @{splat} {cameras} {out}"));
    }
    let copy = format!("@copy.compressed.ply --scene @{scene} --local-origin");
    let scores = sandbox.json(&format!("eval --splat @{splat} --scene @{scene}"));
    let loss = sandbox.json(&format!("convert @{splat} {copy}"));
    [scores, loss].map(|report| number(&report, "/psnr"))
}

/// Returns what the page of `splat` and `scene` contains: it has a local origin, and a unit that suits a browser's precision and the page's
/// step sizes.
fn page_contents(sandbox: &Sandbox, splat: &str, scene: &str) -> Value {
    sandbox.succeed(&format!("render --splat @{splat} --scene @{scene} --html @page.html"));
    let text = sandbox.text("page.html");
    let (_, json) = text.split_once("<script id=\"scene\" type=\"application/json\">").unwrap();
    serde_json::from_str(json.split_once("</script>").unwrap().0).unwrap()
}

fn assert_same_page(a: &Value, b: &Value) {
    for field in ["distance", "frustum"] {
        let ratio = a[field].as_f64().unwrap() / b[field].as_f64().unwrap();
        assert!((ratio - 1.).abs() < 1e-4, "{field}: {ratio}");
    }
    let poses = |page: &Value| -> Vec<Vec<f64>> { serde_json::from_value(page["path"].clone()).unwrap() };
    for (a, b) in poses(a).concat().into_iter().zip(poses(b).concat()) {
        assert!((a - b).abs() < 1e-3, "{a} {b}");
    }
}

#[test]
fn a_splat_looks_the_same_in_any_unit_and_place() {
    let sandbox = Sandbox::new();
    let [room, scene, splat] = ["room", "scene", "a.ply"].map(|name| sandbox.path(name));
    let [plain_psnr, plain_loss] = render_and_score(&sandbox, "room/truth.ply", "room", "plain");
    let plain_page = has_viewer().then(|| page_contents(&sandbox, "room/truth.ply", "room"));
    let read = read_splat(&room.join("truth.ply")).unwrap();
    for place in PLACES {
        let to = to_place(place);
        write_moved(&room, &scene, &to);
        write_local_splat(&splat, &moved_splat(&read, &to), &WriteOptions::default()).unwrap();
        assert_eq!(origin_file(&splat).is_file(), to.translation != DVec3::ZERO);
        let [psnr, loss] = render_and_score(&sandbox, "a.ply", "scene", "pictures");
        let least = least_psnr(&sandbox.path("plain"), &sandbox.path("pictures"));
        assert!(least >= 60., "{place:?}: {least:.2} dB");
        assert!((psnr - plain_psnr).abs() < 0.05, "{place:?}: {psnr:.2} instead of {plain_psnr:.2} dB");
        assert!((loss - plain_loss).abs() < 1., "{place:?}: {loss:.2} instead of {plain_loss:.2} dB");
        if let Some(plain) = &plain_page {
            assert_same_page(plain, &page_contents(&sandbox, "a.ply", "scene"));
        }
        for folder in ["scene", "pictures"] {
            fs::remove_dir_all(sandbox.path(folder)).unwrap();
        }
    }
}

/// A reconstruction and its file are bit-identical up to the exponent.
#[test]
fn powers_of_two_change_no_bit() {
    let sandbox = Sandbox::new();
    let room = sandbox.path("room");
    let ground_truth = read_splat(&room.join("truth.ply")).unwrap();
    let made = |scene: &str| {
        // This format stores linear scales.
        sandbox.succeed(&format!("reconstruct --scene @{scene} --views 3 --out @made.splat"));
        let render = format!("render --splat @made.splat --scene @{scene} --depth --alpha --out @made.png");
        sandbox.succeed(&render);
        (Gaussians::from_splat(&read_splat(&sandbox.path("made.splat")).unwrap()), sandbox.read("made.png"))
    };
    let (plain, pictures) = made("room");
    let cameras = open_capture(&room).unwrap().cameras();
    let seen = SplatRenderer::from_splat(&ground_truth).render(&cameras).unwrap();
    for exponent in [-20, 5] {
        let factor = f64::from(exponent).exp2();
        let scene = sandbox.path(&format!("scene{exponent}"));
        let to = to_place((factor, [0.; 3]));
        write_moved(&room, &scene, &to);
        let (gaussians, same) = made(&format!("scene{exponent}"));
        assert!(gaussians.means.equal(&(&plain.means * factor)), "2^{exponent}");
        assert!(gaussians.scales.equal(&(&plain.scales * factor)), "2^{exponent}");
        assert!(gaussians.quaternions.equal(&plain.quaternions) && gaussians.sh.equal(&plain.sh));
        assert!(pictures == same, "2^{exponent}");
        let cameras = open_capture(&scene).unwrap().cameras();
        let scaled = SplatRenderer::from_splat(&moved_splat(&ground_truth, &to)).render(&cameras).unwrap();
        for (a, b) in seen.iter().zip(&scaled) {
            assert!(a.rgb.equal(&b.rgb) && a.alpha.equal(&b.alpha), "2^{exponent}");
            assert!((&a.depth * factor).equal(&b.depth), "2^{exponent}");
        }
    }
}

/// Far from the origin, the loss in float32 is reported, and a local origin avoids it in all commands that read the splat.
#[test]
fn a_local_origin_keeps_the_detail() {
    let sandbox = Sandbox::new();
    let read = |name: &str| read_splat(&sandbox.path(name)).unwrap();
    let has_origin = |name: &str| origin_file(&sandbox.path(name)).exists();
    let to = to_place(PLACES[2]);
    let offset = to.translation;
    let (scene, local) = (sandbox.path("scene"), sandbox.path("local.ply"));
    write_moved(&sandbox.path("room"), &scene, &to);
    write_local_splat(&local, &moved_splat(&read("room/truth.ply"), &to), &WriteOptions::default()).unwrap();
    let psnr = |splat: &str| number(&sandbox.json(&format!("eval --splat @{splat} --scene @scene")), "/psnr");

    let (_, said) = sandbox
        .succeed_with_messages("convert @local.ply @world.ply --scene @scene --local-origin=off --json");
    assert_eq!(said.lines().count(), 1, "{said}");
    assert_says(&said, &["world.ply", "5.412e6 units", "every 0.5 units", "--local-origin"]);
    assert!(!has_origin("world.ply"));
    let [psnr_local, psnr_world] = ["local.ply", "world.ply"].map(psnr);
    assert!(psnr_local > psnr_world + 10., "{psnr_local} {psnr_world}");

    // Relative to the capture's center, in every format; an older splat's origin is replaced.
    for copy in ["copy.ply", "copy.spz"] {
        let convert = format!("convert @local.ply @{copy} --scene @scene");
        assert_eq!(sandbox.succeed_with_messages(&format!("{convert} --local-origin")).1, "");
        let center = LocalFrame::from_cameras(&open_capture(&scene).unwrap().cameras()).origin;
        let written = sandbox.read_json(&format!("{copy}.origin.json"));
        assert_eq!(written, json!({"origin": center.to_array()}));
        assert!(psnr(copy) > psnr_local.min(45.) - 12., "{copy}: {}", psnr(copy));
        let inspected = sandbox.json(&format!("inspect @{copy}"));
        assert_eq!(inspected["local_origin"], json!(center.to_array()));
        assert!((number(&inspected, "/x/1") - offset.x).abs() < 5., "{inspected}");
        sandbox.succeed(&format!("{convert} --local-origin=off"));
        assert!(!has_origin(copy), "{copy}");
    }

    // Without a capture, a splat without an origin gets its own center.
    sandbox.succeed("convert @world.ply @centered.ply --local-origin");
    assert!(read("centered.ply").origin.distance(offset) < 10.);
    // A splat keeps the origin that it has, as does what is merged, and edits alone give none.
    let means = read("local.ply").means;
    for (line, out, origin, count) in [
        ("convert @local.ply @kept.ply", "kept.ply", offset, means.len()),
        ("convert @local.ply @kept.ply --local-origin", "kept.ply", offset, means.len()),
        ("convert @kept.ply @kept.ply", "kept.ply", offset, means.len()),
        ("convert @room/truth.ply @both.ply --merge @local.ply", "both.ply", offset, 2 * means.len()),
        ("convert @room/truth.ply @moved.ply --translate 9,0,0", "moved.ply", DVec3::ZERO, means.len()),
        (
            "refine --splat @local.ply --scene @scene --steps 2 --out @refined.ply",
            "refined.ply",
            offset,
            means.len(),
        ),
    ] {
        sandbox.succeed(line);
        let written = read(out);
        assert_eq!((written.origin, written.len()), (origin, count), "{line}");
        assert!(out != "kept.ply" || written.means == means, "{line}");
    }

    // A file name that is too long for the origin's file is refused before the work.
    let said = sandbox.refuse(&format!("convert @local.ply @{}.ply --local-origin", "x".repeat(240)));
    assert_says(&said, &[".origin.json can't be written"]);

    // A copy without its origin file still opens, at another position.
    sandbox.copy("local.ply", "lone.ply");
    assert_eq!(read("lone.ply").origin, DVec3::ZERO);
}

#[test]
fn origins_that_are_none_are_refused() {
    let sandbox = Sandbox::new();
    for bad in [
        "",
        "[1, 2, 3]",
        "{}",
        r#"{"origin": [1, 2]}"#,
        r#"{"origin": [1, 2, 1e999]}"#,
        r#"{"origin": [1, "2", 3]}"#,
        r#"{"origin": null}"#,
    ] {
        sandbox.write("room/truth.ply.origin.json", bad);
        for command in ["inspect @room/truth.ply", "convert @room/truth.ply @out.ply"] {
            let said = sandbox.refuse(command);
            assert_says(&said, &["truth.ply.origin.json: the JSON is ", "expected {\"origin\": [x, y, z]}"]);
        }
    }
}
