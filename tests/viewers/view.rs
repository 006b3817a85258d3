//! The interactive page shows the scene in a browser without network access, and reacts to touch and keys.
#![cfg(unix)]

use crate::common::browser::Browser;
use crate::common::program::{Sandbox, arg, assert_says, run_process, succeed};
use crate::common::{captures, has_viewer, write_script};
use crate::{LEAST, assert_like, own_picture, picture_from_base64};
use glam::DVec3;
use globalsplat::data::{load_views, open_capture};
use globalsplat::io::{Splat, read_splat, write_splat};
use globalsplat::metrics::psnr;
use globalsplat::render::depth_colors;
use globalsplat::scene::ImageSize;
use serde_json::{Value, json};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tch::{Kind, Tensor};

const SIDE: u32 = 512;

/// Page in a browser whose window is as large as the square photos, without animations.
struct Shown {
    browser: Browser,
}

impl Shown {
    fn open(page: &Path) -> Option<Self> {
        let mut browser = Browser::start()?;
        let size = json!({"width": SIDE, "height": SIDE, "deviceScaleFactor": 1, "mobile": false});
        browser.call("Emulation.setDeviceMetricsOverride", size);
        let still = json!({"features": [{"name": "prefers-reduced-motion", "value": "reduce"}]});
        browser.call("Emulation.setEmulatedMedia", still);
        browser.open(page);
        let mut shown = Shown { browser };
        shown.wait_for("document.body.dataset.state !== 'loading'");
        let text = shown.value("document.body.innerText");
        assert_eq!(shown.value("document.body.dataset.state"), "ready", "{text}");
        Some(shown)
    }

    fn value(&mut self, expression: &str) -> Value {
        self.browser.evaluate(expression)
    }

    #[track_caller]
    fn wait_for(&mut self, condition: &str) {
        let begun = Instant::now();
        while self.value(condition) != true {
            assert!(begun.elapsed() < Duration::from_secs(60), "{condition} never came true");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Returns the image of the page, without controls, after all changes have finished.
    fn picture(&mut self) -> Tensor {
        self.wait_for("(({ stage, walk }) => !walk.jump && !stage.isDirty && !stage.spark.sorting && !stage.spark.sortDirty)(page)");
        // The last frame must have reached the screen.
        self.value("new Promise((done) => setTimeout(done, 500))");
        self.key("KeyH");
        let picture = self.screen();
        self.key("KeyH");
        picture
    }

    fn screen(&mut self) -> Tensor {
        let png = self.browser.call("Page.captureScreenshot", json!({"format": "png"}));
        picture_from_base64(png["data"].as_str().unwrap())
    }

    /// Presses a key briefly.
    fn key(&mut self, code: &str) {
        self.key_for(code, Duration::ZERO);
    }

    fn key_for(&mut self, code: &str, time: Duration) {
        for kind in ["keyDown", "keyUp"] {
            let key =
                json!({"type": kind, "code": code, "key": code.trim_start_matches("Key").to_lowercase()});
            self.browser.call("Input.dispatchKeyEvent", key);
            if kind == "keyDown" {
                std::thread::sleep(time);
            }
        }
    }

    /// Drags one finger across the touch screen.
    fn draw(&mut self, from: (f64, f64), to: (f64, f64)) {
        self.browser.call("Emulation.setTouchEmulationEnabled", json!({"enabled": true}));
        for step in 0..=8 {
            let share = f64::from(step) / 8.;
            let (x, y) = (from.0 + share * (to.0 - from.0), from.1 + share * (to.1 - from.1));
            let kind = if step == 0 { "touchStart" } else { "touchMove" };
            self.browser
                .call("Input.dispatchTouchEvent", json!({"type": kind, "touchPoints": [{"x": x, "y": y}]}));
            std::thread::sleep(Duration::from_millis(30));
        }
        self.browser.call("Input.dispatchTouchEvent", json!({"type": "touchEnd", "touchPoints": []}));
    }

    fn click(&mut self, selector: &str) {
        self.value(&format!("document.querySelector({selector:?}).click()"));
    }

    /// Returns the position and the quaternion of the page's camera.
    fn place(&mut self) -> Vec<f64> {
        let place = "[...page.stage.camera.position.toArray(), ...page.stage.camera.quaternion.toArray()]";
        serde_json::from_value(self.value(place)).unwrap()
    }
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

/// Returns the first real capture; `None` if there is none, or if the viewer isn't built.
fn capture() -> Option<PathBuf> {
    let capture = captures()?.swap_remove(0);
    has_viewer().then_some(capture)
}

/// Returns our own render from a capture's camera, and the photo, as large as the page.
fn expected(capture: &Path, splat: &Path, index: usize) -> (Tensor, Tensor) {
    let size = ImageSize { width: SIDE, height: SIDE };
    let view = load_views(&open_capture(capture).unwrap(), &[index], Some(size)).unwrap().remove(0);
    (own_picture(&read_splat(splat).unwrap(), view.camera), view.image.to_float())
}

/// Returns the mean distance of an image's pixels from the nearest depth color.
fn from_depth_colors(picture: &Tensor) -> f64 {
    let pixels = picture.flatten(1, 2).transpose(0, 1).contiguous();
    let distances = Tensor::cdist(&pixels, &Tensor::from_slice2(&depth_colors()), 2., None::<i64>);
    distances.amin([1i64].as_slice(), false).mean(Kind::Double).double_value(&[])
}

/// The page shows an antialiased splat of small Gaussians as our rasterizer does.
#[test]
#[ignore = "make test-all: starts a browser"]
fn an_antialiased_splat_is_shown_as_one() {
    let Some(capture) = capture() else { return };
    let folder = tempfile::tempdir().unwrap();
    let [marked, plain, page] = ["marked.ply", "plain.ply", "page.html"].map(|name| folder.path().join(name));
    let mut splat = read_splat(&capture.join("reference.ply")).unwrap();
    splat.log_scales.as_flattened_mut().iter_mut().for_each(|log_scale| *log_scale -= 2.);
    write_splat(&plain, &splat).unwrap();
    write_splat(&marked, &Splat { antialiased: true, ..splat }).unwrap();
    succeed(&["render", "--splat", arg(&marked), "--scene", arg(&capture), "--html", arg(&page)]);
    let Some(mut shown) = Shown::open(&page) else { return };
    let picture = shown.picture();
    let [own, other] = [&marked, &plain].map(|splat| psnr(&picture, &expected(&capture, splat, 0).0));
    println!("an antialiased splat: {own:.2} dB, as another one: {other:.2} dB");
    assert!(own >= LEAST && own > other + 3., "{own:.2} dB, as another one {other:.2} dB");
}

#[test]
#[ignore = "make test-all: starts a browser"]
fn a_page_shows_the_scene_and_can_be_walked_in() {
    let Some(capture) = capture() else { return };
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("page.html");
    let splat = capture.join("reference.ply");
    succeed(&["render", "--splat", arg(&splat), "--scene", arg(&capture), "--html", arg(&page)]);
    let Some(mut shown) = Shown::open(&page) else { return };

    // The view from the first camera matches our own render.
    let (own, photo) = expected(&capture, &splat, 0);
    let picture = shown.picture();
    assert_like("the first camera", &picture, &own, LEAST);
    assert_eq!(shown.value("page.walk.at"), 0);
    let count = open_capture(&capture).unwrap().len();
    assert_eq!(shown.value("document.querySelectorAll('#strip img').length"), count);

    // The slider overlays the photo.
    shown.value("share.value = 1, share.dispatchEvent(new Event('input'))");
    shown.value("document.getElementById('photo').decode()");
    let hide = |how: &str| {
        format!(
            "document.querySelectorAll('header, footer, #share').forEach((of) => of.style.visibility = '{how}')"
        )
    };
    shown.value(&hide("hidden"));
    let over = shown.screen();
    shown.value(&hide("visible"));
    assert_like("the photo", &over, &photo, 28f64.max(psnr(&picture, &photo) + 1.));
    shown.value("share.value = 0, share.dispatchEvent(new Event('input'))");

    // Jump by the photo strip, and by keys.
    shown.click("#strip button:nth-child(4)");
    let jumped = shown.picture();
    let (own, _) = expected(&capture, &splat, 3);
    assert_like("the fourth camera", &jumped, &own, LEAST);
    assert_eq!(shown.value("page.walk.at"), 3);
    shown.key("Comma");
    shown.wait_for("page.walk.at === 2");
    assert_eq!(shown.value("[...strip.children].findIndex((of) => of.hasAttribute('aria-current'))"), 2);
    // Holding the key for many frames jumps to the first photo and nowhere else.
    shown.key_for("Home", Duration::from_millis(500));
    shown.wait_for("page.walk.at === 0");

    // Depth is shown in the depth colors, centers as points.
    shown.key("Digit2");
    let depth = shown.picture();
    assert_eq!(shown.value("document.querySelector('[aria-pressed=true]').id"), "depth");
    let [of_depth, of_photo] = [&depth, &picture].map(from_depth_colors);
    println!("{of_depth:.3} from the colors of depth, in color {of_photo:.3}");
    assert!(of_depth < 0.05 && of_photo > 0.15, "{of_depth} {of_photo}");
    shown.click("#centers");
    let centers = shown.picture();
    let black = centers.lt(0.05).to_kind(Kind::Float).mean(Kind::Float).double_value(&[]);
    assert!((0.5..0.99).contains(&black), "{black} of the points' picture is black");
    shown.click("#color");
    shown.key("Home");
    shown.wait_for("page.walk.at === 0");

    // Two clicks measure a distance, in the coordinates of the file.
    shown.key("KeyM");
    let clicks = [(150., 300.), (400., 260.)];
    for (x, y) in clicks {
        for kind in ["mousePressed", "mouseReleased"] {
            let event = json!({"type": kind, "x": x, "y": y, "button": "left", "clickCount": 1});
            shown.browser.call("Input.dispatchMouseEvent", event);
        }
    }
    let option = shown.value("document.getElementById('length').textContent");
    let words: Vec<&str> = option.as_str().unwrap().split(' ').collect();
    assert!(matches!(words[..], ["--length", _, _, "METRES"]), "{option}");
    let points = [words[1], words[2]]
        .map(|point| DVec3::from_slice(&point.split(',').map(|x| x.parse().unwrap()).collect::<Vec<_>>()));
    let size = ImageSize { width: SIDE, height: SIDE };
    let camera = open_capture(&capture).unwrap().cameras()[0].with_size(size);
    for (point, (x, y)) in points.iter().zip(clicks) {
        let ray = camera.c2w.inverse().transform_point3(*point);
        let k = camera.intrinsics;
        let (u, v) = (k.fx * ray.x / ray.z + k.cx, k.fy * ray.y / ray.z + k.cy);
        assert!(ray.z > 0. && (u - x).hypot(v - y) < 1.5, "{point} is at ({u}, {v}), not at ({x}, {y})");
    }
    let text = shown.value("document.getElementById('distance').textContent");
    let measured: f64 = text.as_str().unwrap().strip_suffix(" units").unwrap().parse().unwrap();
    assert!((measured / points[0].distance(points[1]) - 1.).abs() < 1e-3, "{text} {points:?}");
    shown.key("KeyM");
    assert_eq!(shown.value("measurement.hidden"), true);

    // Walking by keys and turning by touch leave the photo.
    let at_photo = shown.place();
    shown.key_for("KeyS", Duration::from_millis(700));
    shown.wait_for("page.walk.at === null");
    let walked = shown.place();
    assert!(distance(&at_photo[..3], &walked[..3]) > 0.01 && distance(&at_photo[3..], &walked[3..]) < 1e-3);
    assert_eq!(shown.value("compare.hidden"), true);
    // From behind, the camera is visible.
    let before = shown.picture();
    shown.key("KeyC");
    let cameras = shown.picture();
    assert!(psnr(&cameras, &before) < 40., "{:.2} dB: no camera is to be seen", psnr(&cameras, &before));
    shown.key("KeyC");
    shown.draw((200., 200.), (300., 210.));
    let turned = shown.place();
    assert!(distance(&walked[3..], &turned[3..]) > 0.01, "{walked:?} {turned:?}");

    // The path plays until it is stopped, or at its end.
    shown.key("Space");
    shown.wait_for("page.walk.along > 0.05");
    assert_eq!(shown.value("page.walk.isPlaying && document.getElementById('play').textContent"), "Pause");
    shown.key("Space");
    shown.wait_for("!page.walk.isPlaying");
    shown.value("along.value = 1, along.dispatchEvent(new Event('input'))");
    shown.key("Slash");
    assert_eq!(shown.value("document.getElementById('help').open"), true);

    let errors = shown.browser.errors();
    assert!(errors.is_empty(), "{errors:?}");
    let asked: Vec<&str> = shown.browser.requests();
    assert!(asked.iter().all(|url| url.starts_with("file://") || url.starts_with("blob:")), "{asked:?}");
    let pages = asked.iter().filter(|url| url.starts_with("file://")).count();
    assert_eq!(pages, 1, "{asked:?}");
}

#[cfg(target_os = "linux")]
#[test]
fn view_opens_a_page_of_a_splat_alone() {
    if !has_viewer() {
        return;
    }
    let sandbox = Sandbox::new();
    // Names are escaped as text.
    sandbox.copy("room/truth.ply", "a <b>room&.ply");
    // A program `xdg-open` that records the path it is asked to open.
    let opened = sandbox.path("opened");
    write_script(&sandbox.path("xdg-open"), &format!("printf %s \"$1\" > {opened:?}"));
    let path = format!("{}:/usr/bin:/bin", sandbox.folder().display());
    let mut view = sandbox.command("view '@a <b>room&.ply'");
    let (out, err) = run_process(view.env("PATH", path).env("TMPDIR", sandbox.folder()));
    assert_eq!(err, "");
    let page = PathBuf::from(out.trim_end());
    let begun = Instant::now();
    while std::fs::read_to_string(&opened).unwrap_or_default() != arg(&page) {
        assert!(begun.elapsed() < Duration::from_secs(20), "the page was not opened");
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(page.parent().unwrap(), sandbox.folder());

    let Some(mut shown) = Shown::open(&page) else { return };
    assert_eq!(shown.value("document.querySelector('h1').textContent"), "a <b>room&");
    assert_eq!(shown.value("document.title"), "a <b>room&");
    let seen = shown.picture().gt(0.1).to_kind(Kind::Float).mean(Kind::Float).double_value(&[]);
    assert!(seen > 0.05, "{seen} of the picture is not black");
    assert_eq!(shown.value("compare.hidden"), true);
    assert!(shown.browser.errors().is_empty(), "{:?}", shown.browser.errors());
}

/// Without a browser, `view` names its page, which is private and replaces the page before it.
#[cfg(target_os = "linux")]
#[test]
fn pages_are_private_and_replaced_by_the_next() {
    if !has_viewer() {
        return;
    }
    let sandbox = Sandbox::new();
    sandbox.write("temporary/page.html", "somebody's");
    let temporary = sandbox.path("temporary");
    let mut before: Option<PathBuf> = None;
    for _ in 0..2 {
        let mut view = sandbox.command("view @room/truth.ply --scene @room --json");
        let (out, err) = run_process(view.env("PATH", "").env("TMPDIR", &temporary));
        assert!(err.starts_with("no browser could be started (") && err.lines().count() == 1, "{err}");
        let report: Value = serde_json::from_str(&out).unwrap();
        assert_eq!(report["opened"], false);
        let page = PathBuf::from(report["page"].as_str().unwrap());
        assert_eq!(std::fs::metadata(&page).unwrap().permissions().mode() & 0o777, 0o600);
        assert_eq!(std::fs::read_dir(&temporary).unwrap().count(), 2, "the page, and what isn't ours");
        assert!(before.is_none_or(|before| !before.exists()));
        before = Some(page);
    }
    assert!(temporary.join("page.html").exists());
    // Without a folder for it, one sentence says so; a page with a place of its own needs none.
    let nowhere = sandbox.path("nowhere");
    let out = sandbox.command("view @room/truth.ply").env("TMPDIR", &nowhere).output().unwrap();
    let err = String::from_utf8(out.stderr).unwrap();
    assert_eq!((out.status.code(), err.lines().count()), (Some(2), 1), "{err}");
    assert_says(&err, &["nowhere can't be written", "TMPDIR"]);
    run_process(
        sandbox
            .command("render --splat @room/truth.ply --scene @room --html @page.html")
            .env("TMPDIR", &nowhere),
    );
}
