//! Units and origins of captures don't matter: renders are the same in millimetres and kilometres, at the origin and in UTM
//! coordinates, and bit-identical if the unit changes by a power of two (spec 2.5).

use crate::common::has_viewer;
use crate::common::program::{arg, globalsplat, refuse, room, run_json, succeed};
use glam::{DMat3, DMat4, DVec3};
use globalsplat::data::{open_capture, write_cameras_json};
use globalsplat::io::{
    Splat, WriteOptions, origin_file, read_image, read_splat, tensor_from_rgb, write_local_splat, write_splat,
};
use globalsplat::metrics::psnr;
use globalsplat::render::{SplatRenderer, transform};
use globalsplat::scene::{Camera, Gaussians, LocalFrame, Similarity};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use tch::Tensor;

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
    let moved = |camera: Camera| {
        let center = to.scale * (to.rotation * camera.c2w.w_axis.truncate()) + to.translation;
        let c2w = DMat4::from_mat3_translation(to.rotation * DMat3::from_mat4(camera.c2w), center);
        Camera { c2w, ..camera }
    };
    for name in &names {
        fs::create_dir_all(folder.join(name).parent().unwrap()).unwrap();
        fs::copy(from.join(name), folder.join(name)).unwrap();
    }
    let cameras: Vec<Camera> = capture.cameras().into_iter().map(moved).collect();
    write_cameras_json(&folder.join("cameras.json"), &names, &cameras).unwrap();
}

/// Returns `splat` transformed by `to`, to match a capture transformed by `to`. Its origin is the translation.
fn moved_splat(splat: &Splat, to: &Similarity) -> Splat {
    let about_origin = Similarity { translation: DVec3::ZERO, ..*to };
    transform(&Gaussians::from_splat(splat), &about_origin).to_splat(to.translation).unwrap()
}

/// Returns the minimum PSNR of the PNGs of folder `a` compared with those of `b`.
fn least_psnr(a: &Path, b: &Path) -> f64 {
    let images = |folder: &Path| -> BTreeMap<PathBuf, Tensor> {
        let files = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        files.map(|file| (file.clone(), tensor_from_rgb(&read_image(&file).unwrap()))).collect()
    };
    let (a, b) = (images(a), images(b));
    assert!(!a.is_empty() && a.len() == b.len());
    a.values().zip(b.values()).map(|(a, b)| psnr(a, b)).fold(f64::INFINITY, f64::min)
}

/// Renders `splat` from the cameras of `scene`, along a smooth path through them and on orbits, to `pictures`. Returns the PSNR of the
/// splat, and that of a copy with losses, which `convert` tells.
fn render_and_score(splat: &Path, scene: &Path, pictures: &Path) -> [f64; 2] {
    let copy = pictures.with_extension("compressed.ply");
    let (splat, scene) = (arg(splat), arg(scene));
    succeed(&["render", "--splat", splat, "--scene", scene, "--depth", "--out", arg(pictures)]);
    for (name, cameras) in
        [("around", &["--orbit"][..]), ("amid", &["--orbit", "--scene", scene]), ("path", &["--path", scene])]
    {
        let out = pictures.join(format!("{name}.png"));
        let others = ["--splat", splat, "--frames", "3", "--size", "32x24", "--out", arg(&out)];
        succeed(&[&["render"], cameras, &others].concat());
    }
    let scores = run_json(&["eval", "--splat", splat, "--scene", scene, "--json"]);
    let loss = run_json(&["convert", splat, arg(&copy), "--scene", scene, "--local-origin", "--json"]);
    [scores, loss].map(|report| report["psnr"].as_f64().unwrap())
}

/// Returns what the page of `splat` and `scene` contains: it has a local origin, and a unit that suits a browser's precision and the page's
/// step sizes.
fn page_contents(splat: &Path, scene: &Path) -> Value {
    let page = splat.with_extension("html");
    succeed(&["render", "--splat", arg(splat), "--scene", arg(scene), "--html", arg(&page)]);
    let text = fs::read_to_string(page).unwrap();
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
    let (folder, room) = room();
    let ground_truth = room.join("truth.ply");
    let [scene, splat, plain, pictures] =
        ["scene", "a.ply", "plain", "pictures"].map(|name| folder.path().join(name));
    let [plain_psnr, plain_loss] = render_and_score(&ground_truth, &room, &plain);
    let plain_page = has_viewer().then(|| page_contents(&ground_truth, &room));
    let read = read_splat(&ground_truth).unwrap();
    for place in PLACES {
        let to = to_place(place);
        write_moved(&room, &scene, &to);
        write_local_splat(&splat, &moved_splat(&read, &to), &WriteOptions::default()).unwrap();
        assert_eq!(origin_file(&splat).is_file(), to.translation != DVec3::ZERO);
        let [psnr, loss] = render_and_score(&splat, &scene, &pictures);
        let least = least_psnr(&plain, &pictures);
        assert!(least >= 60., "{place:?}: {least:.2} dB");
        assert!((psnr - plain_psnr).abs() < 0.05, "{place:?}: {psnr:.2} instead of {plain_psnr:.2} dB");
        assert!((loss - plain_loss).abs() < 1., "{place:?}: {loss:.2} instead of {plain_loss:.2} dB");
        if let Some(plain) = &plain_page {
            assert_same_page(plain, &page_contents(&splat, &scene));
        }
        fs::remove_dir_all(&scene).unwrap();
        fs::remove_dir_all(&pictures).unwrap();
    }
}

/// A reconstruction and its file are bit-identical up to the exponent.
#[test]
fn powers_of_two_change_no_bit() {
    let (folder, room) = room();
    let ground_truth = read_splat(&room.join("truth.ply")).unwrap();
    let of = |name: &str| folder.path().join(name);
    let made = |scene: &Path, name: &str| {
        // This format stores linear scales.
        let (out, pictures) = (of(&format!("{name}.splat")), of(&format!("{name}.png")));
        succeed(&["reconstruct", "--scene", arg(scene), "--views", "3", "--out", arg(&out)]);
        let render = ["render", "--splat", arg(&out), "--scene", arg(scene), "--depth", "--alpha"];
        succeed(&[&render[..], &["--out", arg(&pictures)]].concat());
        (Gaussians::from_splat(&read_splat(&out).unwrap()), fs::read(&pictures).unwrap())
    };
    let (plain, pictures) = made(&room, "plain");
    let cameras = open_capture(&room).unwrap().cameras();
    let seen = SplatRenderer::from_splat(&ground_truth).render(&cameras).unwrap();
    for exponent in [-20, 5] {
        let factor = f64::from(exponent).exp2();
        let scene = of(&format!("scene{exponent}"));
        let to = to_place((factor, [0.; 3]));
        write_moved(&room, &scene, &to);
        let (gaussians, same) = made(&scene, "scaled");
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
    let (folder, room) = room();
    let ground_truth = read_splat(&room.join("truth.ply")).unwrap();
    let of = |name: &str| folder.path().join(name);
    let to = to_place(PLACES[2]);
    let offset = to.translation;
    let (scene, local, world) = (of("scene"), of("local.ply"), of("world.ply"));
    write_moved(&room, &scene, &to);
    write_local_splat(&local, &moved_splat(&ground_truth, &to), &WriteOptions::default()).unwrap();
    let psnr = |splat: &Path| {
        run_json(&["eval", "--splat", arg(splat), "--scene", arg(&scene), "--json"])["psnr"].as_f64().unwrap()
    };

    let output = globalsplat(&["convert", arg(&local), arg(&world), "--scene", arg(&scene), "--json"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && said.lines().count() == 1, "{said}");
    for part in ["world.ply", "5.412e6 units", "every 0.5 units", "--local-origin"] {
        assert!(said.contains(part), "{said}");
    }
    assert!(!origin_file(&world).exists());
    assert!(psnr(&local) > psnr(&world) + 10., "{} {}", psnr(&local), psnr(&world));

    // Relative to the capture's center, in every format; an older splat's origin is replaced.
    for ending in ["ply", "spz"] {
        let copy = of(&format!("copy.{ending}"));
        let convert = ["convert", arg(&local), arg(&copy), "--scene", arg(&scene)];
        let output = globalsplat(&[&convert[..], &["--local-origin"]].concat());
        assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
        let center = LocalFrame::from_cameras(&open_capture(&scene).unwrap().cameras()).origin;
        let written: Value = serde_json::from_slice(&fs::read(origin_file(&copy)).unwrap()).unwrap();
        assert_eq!(written, json!({"origin": center.to_array()}));
        assert!(psnr(&copy) > psnr(&local).min(45.) - 12., "{ending}: {}", psnr(&copy));
        let inspected = run_json(&["inspect", arg(&copy), "--json"]);
        assert_eq!(inspected["local_origin"], json!(center.to_array()));
        assert!((inspected["x"][1].as_f64().unwrap() - offset.x).abs() < 5., "{inspected}");
        succeed(&convert);
        assert!(!origin_file(&copy).exists(), "{ending}");
    }

    // Without a capture, a splat keeps its origin, and one without an origin gets its own center.
    let copy = of("kept.ply");
    succeed(&["convert", arg(&local), arg(&copy), "--local-origin"]);
    assert_eq!(read_splat(&copy).unwrap().origin, offset);
    succeed(&["convert", arg(&world), arg(&copy), "--local-origin"]);
    assert!(read_splat(&copy).unwrap().origin.distance(offset) < 10.);

    // A file name that is too long for the origin's file is refused before the work.
    let long = of(&format!("{}.ply", "x".repeat(240)));
    let said = refuse(&["convert", arg(&local), arg(&long), "--local-origin"]);
    assert!(said.contains(".origin.json can't be written"), "{said}");

    // A copy without its origin file still opens, at another position.
    let lone = of("lone.ply");
    fs::copy(&local, &lone).unwrap();
    assert_eq!(read_splat(&lone).unwrap().origin, DVec3::ZERO);
    // Writing by the library in world coordinates removes the origin file.
    write_splat(&local, &read_splat(&local).unwrap()).unwrap();
    assert!(!origin_file(&local).exists() && read_splat(&local).unwrap().origin == DVec3::ZERO);
}

#[test]
fn origins_that_are_none_are_refused() {
    let (folder, room) = room();
    let splat = room.join("truth.ply");
    let out = folder.path().join("out.ply");
    let (inspect, convert) = (["inspect", arg(&splat)], ["convert", arg(&splat), arg(&out)]);
    for (bad, command) in [
        ("", &inspect[..]),
        ("[1, 2, 3]", &inspect),
        ("{}", &inspect),
        ("{\"origin\": [1, 2]}", &inspect),
        ("{\"origin\": [1, 2, 1e999]}", &inspect),
        ("{\"origin\": [1, \"2\", 3]}", &inspect),
        ("{\"origin\": null}", &convert),
    ] {
        fs::write(origin_file(&splat), bad).unwrap();
        let said = refuse(command);
        for part in ["truth.ply.origin.json: the JSON is ", "expected {\"origin\": [x, y, z]}"] {
            assert!(said.contains(part), "{bad}: {said}");
        }
    }
}
