//! Captures in any unit, anywhere: the same pictures of millimetres as of kilometres, at the origin as in UTM coordinates, and the
//! same bits where the unit is another power of two (spec 2.5).

mod common;

use common::program::{arg, globalsplat, refuse, room, succeed};
use common::{captures, skip};
use glam::DMat3;
use glam::DVec3;
use globalsplat::data::{open_capture, write_cameras_json};
use globalsplat::eval::psnr;
use globalsplat::io::{
    Splat, origin_file, read_image, read_splat, tensor_from_rgb, write_local_splat, write_splat,
};
use globalsplat::render::transform;
use globalsplat::scene::{Camera, LocalFrame, Similarity};
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};
use tch::Kind;

/// Units and origins, among them kilometres, UTM and ECEF coordinates.
const PLACES: [(f64, [f64; 3]); 7] = [
    (1e-6, [0.; 3]),
    (1e-3, [0.; 3]),
    (37., [0.; 3]),
    (1e6, [0.; 3]),
    (1., [448_265.12, 5_411_920.65, 135.4]),
    (1e3, [1e8, -1e8, 1e8]),
    (1., [-1e8, 3e7, 7e6]),
];

/// The capture at `from` with positions times `factor` plus `offset`, in the folder `to`.
fn moved(from: &Path, to: &Path, factor: f64, offset: DVec3) {
    let capture = open_capture(from).unwrap();
    let names: Vec<String> = capture.names().map(String::from).collect();
    let moved = |mut camera: Camera| {
        camera.c2w.w_axis = (camera.c2w.w_axis.truncate() * factor + offset).extend(1.);
        camera
    };
    for name in &names {
        fs::create_dir_all(to.join(name).parent().unwrap()).unwrap();
        fs::copy(from.join(name), to.join(name)).unwrap();
    }
    let cameras: Vec<Camera> = capture.cameras().into_iter().map(moved).collect();
    write_cameras_json(&to.join("cameras.json"), &names, &cameras).unwrap();
}

/// The splat that a capture that was moved so sees the same of.
fn moved_splat(splat: &Splat, factor: f64, offset: DVec3) -> Splat {
    let to = Similarity { rotation: DMat3::IDENTITY, translation: DVec3::ZERO, scale: factor };
    let gaussians = transform(&splat.gaussians, &to);
    Splat { origin: splat.origin * factor + offset, ..Splat::of(&gaussians).unwrap() }
}

fn told(arguments: &[&str]) -> Value {
    serde_json::from_str(&succeed(arguments)).expect("JSON")
}

/// The PNGs of `folder`, by name.
fn pictures(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    assert!(!files.is_empty());
    files
}

/// The least PSNR of a picture of the folder `a` beside that of `b`.
fn least_psnr(a: &Path, b: &Path) -> f64 {
    let image = |path: &Path| tensor_from_rgb(&read_image(path).unwrap());
    let both = pictures(a).into_iter().zip(pictures(b));
    both.map(|(a, b)| psnr(&image(&a), &image(&b))).fold(f64::INFINITY, f64::min)
}

#[test]
fn a_splat_looks_the_same_in_any_unit_and_place() {
    let (folder, room) = room();
    let truth = read_splat(&room.join("truth.ply")).unwrap();
    let of = |name: &str| folder.path().join(name);
    let render = |splat: &Path, scene: &Path, out: &Path| {
        succeed(&["render", "--splat", arg(splat), "--scene", arg(scene), "--depth", "--out", arg(out)])
    };
    let eval = |splat: &Path, scene: &Path| {
        told(&["eval", "--splat", arg(splat), "--scene", arg(scene), "--json"])["psnr"].as_f64().unwrap()
    };
    render(&room.join("truth.ply"), &room, &of("plain"));
    let plain_psnr = eval(&room.join("truth.ply"), &room);
    let converted = |from: &Path, to: &Path, scene: &Path| {
        told(&["convert", arg(from), arg(to), "--scene", arg(scene), "--local-origin", "--json"])["psnr"]
            .as_f64()
    };
    let plain_loss = converted(&room.join("truth.ply"), &of("plain.compressed.ply"), &room).unwrap();
    for (factor, offset) in PLACES {
        let what = format!("times {factor}, at {offset:?}");
        let offset = DVec3::from_array(offset);
        let (scene, splat) = (of("scene"), of("a.ply"));
        moved(&room, &scene, factor, offset);
        write_local_splat(&splat, &moved_splat(&truth, factor, offset)).unwrap();
        assert_eq!(origin_file(&splat).is_file(), offset != DVec3::ZERO);
        render(&splat, &scene, &of("pictures"));
        let least = least_psnr(&of("plain"), &of("pictures"));
        assert!(least >= 60., "{what}: {least:.2} dB");
        assert!((eval(&splat, &scene) - plain_psnr).abs() < 0.05, "{what}");
        let copy = of("a.compressed.ply");
        let loss = converted(&splat, &copy, &scene).unwrap();
        assert!((loss - plain_loss).abs() < 1., "{what}: {loss:.2} instead of {plain_loss:.2} dB");
        // Whoever looks at it.
        for cameras in [&["--orbit"][..], &["--orbit", "--scene", arg(&scene)], &["--path", arg(&scene)]] {
            let out = of("orbit.png");
            let frames = ["--frames", "3", "--size", "32x24"];
            let begins = ["render", "--splat", arg(&splat), "--out", arg(&out)];
            succeed(&[&begins[..], cameras, &frames].concat());
            let seen = tensor_from_rgb(&read_image(&out).unwrap());
            let plain_scene = cameras.iter().map(|a| if *a == arg(&scene) { arg(&room) } else { a });
            let plain_splat = room.join("truth.ply");
            let begins = ["render", "--splat", arg(&plain_splat), "--out", arg(&out)];
            succeed(&[&begins[..], &plain_scene.collect::<Vec<_>>(), &frames].concat());
            let least = psnr(&seen, &tensor_from_rgb(&read_image(&out).unwrap()));
            assert!(least >= 60., "{what}, {cameras:?}: {least:.2} dB");
        }
        fs::remove_dir_all(&scene).unwrap();
        fs::remove_dir_all(of("pictures")).unwrap();
    }
}

/// What a model makes of photos, and its file, are the same bits but for the exponent.
#[test]
fn powers_of_two_change_no_bit() {
    let (folder, room) = room();
    let truth = read_splat(&room.join("truth.ply")).unwrap();
    let of = |name: &str| folder.path().join(name);
    let made = |scene: &Path, name: &str| {
        // Scales are linear in this format.
        let (out, pictures) = (of(&format!("{name}.splat")), of(&format!("{name}.png")));
        succeed(&["reconstruct", "--scene", arg(scene), "--views", "3", "--out", arg(&out)]);
        succeed(&[
            "render",
            "--splat",
            arg(&out),
            "--scene",
            arg(scene),
            "--depth",
            "--alpha",
            "--out",
            arg(&pictures),
        ]);
        (read_splat(&out).unwrap().gaussians, fs::read(&pictures).unwrap())
    };
    let (plain, pictures) = made(&room, "plain");
    let cameras = open_capture(&room).unwrap().cameras();
    let seen = truth.renderer().render(&cameras).unwrap();
    for exponent in [-20, -3, 5, 20] {
        let factor = f64::from(exponent).exp2();
        let scene = of(&format!("scene{exponent}"));
        moved(&room, &scene, factor, DVec3::ZERO);
        let (gaussians, same) = made(&scene, "scaled");
        assert!(gaussians.means.equal(&(&plain.means * factor)), "2^{exponent}");
        assert!(gaussians.scales.equal(&(&plain.scales * factor)), "2^{exponent}");
        assert!(gaussians.quaternions.equal(&plain.quaternions) && gaussians.sh.equal(&plain.sh));
        assert!(pictures == same, "2^{exponent}");
        let cameras = open_capture(&scene).unwrap().cameras();
        let scaled = moved_splat(&truth, factor, DVec3::ZERO).renderer().render(&cameras).unwrap();
        for (a, b) in seen.iter().zip(&scaled) {
            assert!(a.rgb.equal(&b.rgb) && a.alpha.equal(&b.alpha), "2^{exponent}");
            assert!((&a.depth * factor).equal(&b.depth), "2^{exponent}");
        }
    }
}

/// A page is about a local origin, in a unit that a browser's numbers and the page's steps are for.
#[test]
fn a_page_is_the_same_in_any_unit_and_place() {
    if told(&["doctor", "--json"])["viewer"] != true {
        skip("npm", "this program was built without the viewer");
        return;
    }
    let (folder, room) = room();
    let truth = read_splat(&room.join("truth.ply")).unwrap();
    let of = |name: &str| folder.path().join(name);
    let contents = |splat: &Path, scene: &Path| -> Value {
        let page = of("page.html");
        succeed(&["render", "--splat", arg(splat), "--scene", arg(scene), "--html", arg(&page)]);
        let text = fs::read_to_string(page).unwrap();
        let (_, json) = text.split_once("<script id=\"scene\" type=\"application/json\">").unwrap();
        serde_json::from_str(json.split_once("</script>").unwrap().0).unwrap()
    };
    let plain = contents(&room.join("truth.ply"), &room);
    for (factor, offset) in PLACES {
        let offset = DVec3::from_array(offset);
        let (scene, splat) = (of("scene"), of("a.ply"));
        moved(&room, &scene, factor, offset);
        write_local_splat(&splat, &moved_splat(&truth, factor, offset)).unwrap();
        let other = contents(&splat, &scene);
        for (path, least) in [("/distance", 1e-4), ("/frustum", 1e-4)] {
            let number = |value: &Value| value.pointer(path).unwrap().as_f64().unwrap();
            assert!((number(&plain) / number(&other) - 1.).abs() < least, "{path}: {factor} {offset}");
        }
        for (a, b) in plain["path"].as_array().unwrap().iter().zip(other["path"].as_array().unwrap()) {
            let numbers = |pose: &Value| -> Vec<f64> { serde_json::from_value(pose.clone()).unwrap() };
            for (a, b) in numbers(a).iter().zip(numbers(b)) {
                assert!((a - b).abs() < 1e-3, "{factor} {offset}: {a} {b}");
            }
        }
    }
}

/// Far from the origin it is said what float32 loses, and a local origin keeps it, for whatever takes up the splat.
#[test]
fn a_local_origin_keeps_the_detail() {
    let (folder, room) = room();
    let truth = read_splat(&room.join("truth.ply")).unwrap();
    let of = |name: &str| folder.path().join(name);
    let offset = DVec3::new(448_265.12, 5_411_920.65, 135.4);
    let (scene, local, world) = (of("scene"), of("local.ply"), of("world.ply"));
    moved(&room, &scene, 1., offset);
    write_local_splat(&local, &moved_splat(&truth, 1., offset)).unwrap();
    let psnr = |splat: &Path| {
        told(&["eval", "--splat", arg(splat), "--scene", arg(&scene), "--json"])["psnr"].as_f64().unwrap()
    };

    let output = globalsplat(&["convert", arg(&local), arg(&world), "--scene", arg(&scene), "--json"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && said.lines().count() == 1, "{said}");
    for part in ["world.ply", "5.412e6 units", "0.50 apart", "--local-origin"] {
        assert!(said.contains(part), "{said}");
    }
    assert!(!origin_file(&world).exists());
    assert!(psnr(&local) > psnr(&world) + 10., "{} {}", psnr(&local), psnr(&world));

    // About the capture's centre, in every format; an origin of an older splat goes.
    for ending in ["ply", "compressed.ply", "spz", "splat"] {
        let copy = of(&format!("copy.{ending}"));
        let convert = ["convert", arg(&local), arg(&copy), "--scene", arg(&scene)];
        let output = globalsplat(&[&convert[..], &["--local-origin"]].concat());
        assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
        let centre = LocalFrame::from_cameras(&open_capture(&scene).unwrap().cameras()).origin;
        let written: Value = serde_json::from_slice(&fs::read(origin_file(&copy)).unwrap()).unwrap();
        assert_eq!(written, json!({"origin": centre.to_array()}));
        assert!(psnr(&copy) > psnr(&local).min(45.) - 12., "{ending}: {}", psnr(&copy));
        let inspected = told(&["inspect", arg(&copy), "--json"]);
        assert_eq!(inspected["local_origin"], json!(centre.to_array()));
        assert!((inspected["x"][1].as_f64().unwrap() - offset.x).abs() < 5., "{inspected}");
        succeed(&convert);
        assert!(!origin_file(&copy).exists(), "{ending}");
    }

    // Without a capture a splat keeps its origin, and one that has none is moved to its own middle.
    let copy = of("kept.ply");
    succeed(&["convert", arg(&local), arg(&copy), "--local-origin"]);
    assert_eq!(read_splat(&copy).unwrap().origin, offset);
    succeed(&["convert", arg(&world), arg(&copy), "--local-origin"]);
    assert!(read_splat(&copy).unwrap().origin.distance(offset) < 10.);

    // Moved without its origin, it still opens, elsewhere.
    let lone = of("lone.ply");
    fs::copy(&local, &lone).unwrap();
    assert_eq!(read_splat(&lone).unwrap().origin, DVec3::ZERO);
    // What writes by the library in world coordinates takes the origin away.
    write_splat(&local, &read_splat(&local).unwrap()).unwrap();
    assert!(!origin_file(&local).exists() && read_splat(&local).unwrap().origin == DVec3::ZERO);
}

#[test]
fn origins_that_are_none_are_refused() {
    let (folder, room) = room();
    let splat = room.join("truth.ply");
    let (out, scene) = (folder.path().join("out.ply"), arg(&room));
    let page = folder.path().join("out.html");
    for bad in [
        "",
        "[1, 2, 3]",
        "{\"origin\": [1, 2]}",
        "{\"origin\": [1, 2, 1e999]}",
        "{\"origin\": [1, \"2\", 3]}",
        "{}",
    ] {
        fs::write(origin_file(&splat), bad).unwrap();
        for command in [
            &["render", "--splat", arg(&splat), "--scene", scene, "--out", arg(folder.path())][..],
            &["render", "--splat", arg(&splat), "--scene", scene, "--html", arg(&page)],
            &["eval", "--splat", arg(&splat), "--scene", scene],
            &["convert", arg(&splat), arg(&out)],
            &["refine", "--splat", arg(&splat), "--scene", scene, "--steps", "1", "--out", arg(&out)],
            &["inspect", arg(&splat)],
        ] {
            let said = refuse(command);
            assert!(
                said.contains("truth.ply.origin.json: the JSON is ") && said.contains("expected {\"origin\""),
                "{said}"
            );
        }
    }
}

/// A real capture in kilometres and in UTM coordinates scores what it scores where it is.
#[test]
fn real_captures_score_the_same_anywhere() {
    let Some(capture) = captures().map(|mut captures| captures.swap_remove(0)) else { return };
    let folder = tempfile::tempdir().unwrap();
    let of = |name: &str| folder.path().join(name);
    let score = |scene: &Path, name: &str| {
        let splat = of(name);
        succeed(&["reconstruct", "--scene", arg(scene), "--out", arg(&splat), "--local-origin"]);
        let pictures = of(&format!("{name}.pictures"));
        succeed(&["render", "--splat", arg(&splat), "--scene", arg(scene), "--out", arg(&pictures)]);
        pictures
    };
    let plain = score(&capture, "plain.ply");
    for (factor, offset) in [PLACES[0], PLACES[1], PLACES[4], PLACES[5]] {
        let scene = of("scene");
        moved(&capture, &scene, factor, DVec3::from_array(offset));
        let other = score(&scene, "moved.ply");
        let least = least_psnr(&plain, &other);
        assert!(least >= 60., "times {factor}, at {offset:?}: {least:.2} dB");
        let loaded = read_splat(&of("moved.ply")).unwrap();
        assert_eq!(loaded.gaussians.means.kind(), Kind::Float);
        fs::remove_dir_all(&scene).unwrap();
    }
}
