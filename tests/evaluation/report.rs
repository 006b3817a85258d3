//! The report: contents of the file, and its appearance in a browser.

use crate::common::browser::Browser;
use crate::common::program::{arg, refuse, succeed};
use globalsplat::eval::{
    Efficiency, Evaluation, Failure, SceneScores, Summary, comparison_path, read_evaluation,
    write_evaluation, write_report,
};
use globalsplat::metrics::{CaptureScores, Scores, ViewScore};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Names that a page must show as text instead of executing them.
const SCRIPT: &str = "<script>window.injected = true</script>";
const PICTURE: &str = "<img src=x onerror='window.injected = true'>";

fn scene(name: &str, psnr: f64, lpips: bool) -> SceneScores {
    let (lpips_vgg, lpips_alex) = (lpips.then_some(psnr / 128.), lpips.then_some(psnr / 256.));
    let ssim = psnr / 64.; // exact in binary, like all values here, and so exact in JSON
    let view = |i: i32| {
        let psnr = psnr + f64::from(i - 1);
        ViewScore {
            image: format!("{i:06}.png"),
            scores: Scores {
                psnr,
                cc_psnr: psnr,
                ssim,
                lpips_vgg,
                lpips_alex,
                pixel_fraction: None,
                depth_error: None,
            },
        }
    };
    let views = (0..3).map(view).collect();
    let scores = CaptureScores::from_views(name, views, Some(16_384));
    let forward_seconds = Some(0.25);
    SceneScores {
        scores,
        context: vec![0, 9, 20],
        target: vec![4, 12, 17],
        enlarged: false,
        splat_bytes: None,
        warnings: vec![],
        warm_up: false,
        forward_seconds,
        peak_memory_bytes: None,
        peak_device_memory_bytes: None,
    }
}

fn evaluation(method: &str, dataset: &str, context_views: usize, scenes: Vec<SceneScores>) -> Evaluation {
    Evaluation {
        method: method.into(),
        dataset: dataset.into(),
        index: format!("{dataset}_{context_views}.json"),
        context_views,
        image_size: [256, 256],
        indexed_scenes: scenes.len(),
        summary: Summary::from_scenes(&scenes),
        efficiency: None,
        machine: "a machine".into(),
        scenes,
        failures: vec![],
    }
}

/// Returns a method on RealEstate10K with 24 views, 64 scenes, all but one with an image; and another on ACID with 12 views
/// that scored two scenes of many, without LPIPS, and failed on one. All names contain special characters.
fn made_up(folder: &Path) -> Vec<(PathBuf, Evaluation)> {
    let names = |i: usize| if i == 0 { SCRIPT.to_string() } else { format!("scene {i} & more") };
    let scenes = (0..64).map(|i| scene(&names(i), 20. + 0.125 * i as f64, true)).collect();
    let mut whole = evaluation("Mine 16K", "re10k", 24, scenes);
    whole.efficiency = Some(Efficiency {
        forward_seconds: 0.25,
        timed_scenes: 63,
        peak_memory_bytes: 1_100_000_000,
        peak_device_memory_bytes: Some(1_730_000_000),
        splat_bytes: 4_064_762.,
    });
    let mut part = evaluation(PICTURE, "ACID", 12, vec![scene("../up", 24., false), scene("b", 26., false)]);
    part.indexed_scenes = 5_601;
    part.failures =
        vec![Failure { scene: "c</style>".into(), error: format!("c.torch: {SCRIPT} is unreadable") }];
    let evaluations = vec![(folder.join("whole"), whole), (folder.join("part"), part)];
    for (folder, evaluation) in &evaluations {
        std::fs::create_dir_all(folder.join("scenes")).unwrap();
        for scene in evaluation.scenes.iter().filter(|scene| scene.scores.scene != "b") {
            let color = image::Rgb([90, 120, (scene.scores.mean.psnr * 5.) as u8]);
            image::RgbImage::from_pixel(1036, 256, color)
                .save(comparison_path(folder, &scene.scores.scene))
                .unwrap();
        }
        write_evaluation(folder, evaluation).unwrap();
    }
    evaluations
}

fn report() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("report.html");
    write_report(&page, &made_up(folder.path())).unwrap();
    (folder, page)
}

#[test]
fn the_report_is_self_contained_and_marks_missing_scores() {
    let (_folder, page) = report();
    let text = std::fs::read_to_string(page).unwrap();
    for attribute in ["src=\"", "href=\"", "url(", "@import", "srcset"] {
        for (at, _) in text.match_indices(attribute) {
            let rest = &text[at + attribute.len()..];
            let own = rest.starts_with("data:") || rest.starts_with('#');
            assert!(own, "{attribute}{}", rest.chars().take(40).collect::<String>());
        }
    }
    assert!(!text.contains("http"), "no address at all");
    assert!(!text.contains(SCRIPT) && !text.contains(PICTURE) && !text.contains("c</style>"));
    assert!(text.contains("&lt;script&gt;window.injected") && text.contains("scene 1 &amp; more"));
    assert!(text.contains("2 of 5,601 scenes"));
    let row =
        text.split("<tr").find(|row| row.contains("onerror") && row.contains("25.00")).expect("the row");
    assert!(row.contains("absent") && row.contains("measured here") && !row.contains("0.000"), "{row}");
    assert_eq!(text.matches("data:image/jpeg").count(), 59, "sixty scenes, one without a picture");
}

#[test]
fn an_evaluation_that_failed_throughout_has_no_means() {
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("report.html");
    let mut evaluation = evaluation("m", "re10k", 24, vec![]);
    evaluation.indexed_scenes = 1;
    evaluation.failures = vec![Failure { scene: "a".into(), error: "unreadable".into() }];
    write_report(&page, &[(folder.path().into(), evaluation)]).unwrap();
    let text = std::fs::read_to_string(page).unwrap().replace("isNaN", "");
    assert!(text.contains("0 of 1 scene<") && text.contains("unreadable") && !text.contains("NaN"));
    assert!(write_report(folder.path(), &[]).unwrap_err().to_string().contains("found none"));
}

#[test]
fn scores_are_read_as_they_were_written() {
    let folder = tempfile::tempdir().unwrap();
    for (folder, evaluation) in made_up(folder.path()) {
        let read = read_evaluation(&folder).unwrap();
        assert_eq!(serde_json::to_value(read).unwrap(), serde_json::to_value(evaluation).unwrap());
    }
}

#[test]
fn the_csv_has_a_line_for_every_view() {
    let folder = tempfile::tempdir().unwrap();
    let mut scenes = vec![scene("a, \"b\"", 25., true), scene("c", 25., false)];
    scenes[1].forward_seconds = None;
    write_evaluation(folder.path(), &evaluation("m", "re10k", 24, scenes)).unwrap();
    let text = std::fs::read_to_string(folder.path().join("scores.csv")).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 1 + 2 * 3);
    assert_eq!(lines[0], "scene,view,psnr,ssim,lpips_vgg,lpips_alex,gaussians,forward_seconds");
    assert_eq!(lines[1], r#""a, ""b""",000000.png,24.0,0.390625,0.1953125,0.09765625,16384,0.25"#);
    assert_eq!(lines[4], "c,000000.png,24.0,0.390625,,,16384,");
}

#[test]
fn the_command_writes_the_page_and_refuses_in_a_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let evaluations = made_up(folder.path());
    let page = folder.path().join("new/report.html");
    let (whole, part) = (arg(&evaluations[0].0), arg(&evaluations[1].0));
    let printed = succeed(&["report", whole, part, "--out", arg(&page), "--json"]);
    let object: Value = serde_json::from_str(&printed).unwrap();
    assert_eq!(object["bytes"], page.metadata().unwrap().len());
    assert_eq!(object["evaluations"][0]["scenes"], 64);
    assert_eq!(object["evaluations"][1]["failures"], 1);

    let absent = folder.path().join("absent");
    let error = refuse(&["report", arg(&absent), "--out", arg(&page)]);
    assert!(error.contains("absent/scores.json can't be read"), "{error}");
    let scores = evaluations[0].0.join("scores.json");
    let text = std::fs::read_to_string(&scores).unwrap();
    std::fs::write(&scores, text.replace("\"index\"", "\"inde\"")).unwrap();
    let error = refuse(&["report", whole, "--out", arg(&page)]);
    assert!(error.contains("whole/scores.json") && error.contains("missing field `index`"), "{error}");
    std::fs::write(&scores, &text[..text.len() / 2]).unwrap();
    assert!(refuse(&["report", whole, "--out", arg(&page)]).contains("EOF while parsing"));
    let picture = comparison_path(&evaluations[1].0, "../up");
    std::fs::write(&picture, "no picture").unwrap();
    let error = refuse(&["report", part, "--out", arg(&page)]);
    assert!(error.contains(arg(&picture)) && error.contains("undecodable"), "{error}");
}

/// Script that finds texts with a contrast to their background below 4.5, the threshold of WCAG's level AA.
const FAINT: &str = r#"(() => {
    const channels = (color) => color.match(/[\d.]+/g).map(Number);
    const luminance = (color) => {
        const linear = (v) => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
        const [r, g, b] = color.map(linear);
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const behind = (element) => {
        for (; element; element = element.parentElement) {
            const color = channels(getComputedStyle(element).backgroundColor);
            if (color.length < 4) return color;
            if (color[3] > 0) throw new Error("a translucent ground");
        }
        throw new Error("no ground");
    };
    const faint = [];
    let texts = 0;
    for (const element of document.body.querySelectorAll("*")) {
        const text = [...element.childNodes].filter((n) => n.nodeType === 3 && n.data.trim()).map((n) => n.data).join("");
        if (!text || ["title", "SCRIPT"].includes(element.tagName) || !element.checkVisibility()) continue;
        texts += 1;
        const style = getComputedStyle(element);
        const color = channels(element.ownerSVGElement ? style.fill : style.color);
        if (color.length > 3) faint.push(`${text}: translucent`);
        const [a, b] = [color.slice(0, 3), behind(element)].map(luminance);
        const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
        if (contrast < 4.5) faint.push(`${text}: ${contrast}`);
    }
    return { faint, texts };
})()"#;

/// Script that counts the visible rows, by the caption of their table.
const ROWS: &str = r#"Object.fromEntries([...document.querySelectorAll("table")].map((table) => [
    table.caption.textContent,
    [...table.tBodies[0].rows].filter((row) => row.checkVisibility() && row.getBoundingClientRect().height > 0).length,
]))"#;

/// Script that finds defects of plots: an empty plot, or texts that are cut or overlap.
const BAD_PLOTS: &str = r#"[...document.querySelectorAll("svg")].flatMap((svg) => {
    const area = svg.getBoundingClientRect();
    const bad = area.width > 100 && area.height > 100 ? [] : ["empty"];
    const texts = [...svg.querySelectorAll("text")].map((text) => [text.textContent, text.getBoundingClientRect()]);
    for (const [name, a] of texts) {
        if (a.left < area.left - 1 || a.right > area.right + 1 || a.top < area.top - 1 || a.bottom > area.bottom + 1)
            bad.push(`${name} is cut`);
        for (const [other, b] of texts) {
            const width = Math.min(a.right, b.right) - Math.max(a.left, b.left);
            const height = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
            if (name < other && width > 1 && height > 4) bad.push(`${name} covers ${other}`);
        }
    }
    return bad.map((what) => `${svg.getAttribute("aria-label")}: ${what}`);
})"#;

const OPEN_ALL: &str = "document.querySelectorAll('details').forEach((details) => { details.open = true; })";

fn strings(value: &Value) -> Vec<&str> {
    value.as_array().expect("a list").iter().map(|item| item.as_str().expect("a string")).collect()
}

#[test]
fn a_browser_shows_it_in_light_and_dark_wide_and_narrow() {
    let Some(mut browser) = Browser::start() else { return };
    let (_folder, page) = report();
    let mut grounds = vec![];
    for scheme in ["light", "dark"] {
        for width in [1280, 400] {
            browser.set_viewport(width, scheme, "screen");
            browser.open(&page);
            browser.evaluate(OPEN_ALL);
            let faint = browser.evaluate(FAINT);
            assert_eq!(strings(&faint["faint"]), [""; 0], "{scheme}");
            assert!(faint["texts"].as_u64() > Some(1000), "{}", faint["texts"]);
            let stands_out = "document.documentElement.scrollWidth - document.documentElement.clientWidth";
            assert_eq!(browser.evaluate(stands_out), 0, "at {width}");
            assert_eq!(strings(&browser.evaluate(BAD_PLOTS)), [""; 0], "at {width}");
            grounds.push(browser.evaluate("getComputedStyle(document.body).backgroundColor"));

            // Images are decoded lazily; decode all.
            let pictures = "Promise.all([...document.images].map((image) => image.decode().then(
                () => image.naturalWidth === 1036 && image.width > 300 && image.alt.length > 20, () => false)))";
            let pictures = browser.evaluate(pictures);
            assert_eq!(pictures.as_array().map(Vec::len), Some(59));
            assert!(pictures.as_array().expect("a list").iter().all(|loaded| *loaded == true), "{pictures}");

            let plots = "document.querySelectorAll('svg').length";
            assert_eq!(browser.evaluate(plots), 2 * 3, "views, distribution and size, of two evaluations");
            assert_eq!(
                browser.evaluate("[document.scripts.length, window.injected ?? 'no']"),
                json!([1, "no"])
            );
            assert_eq!(browser.errors(), [&json!(null); 0]);
            assert_eq!(browser.requests().len(), 1, "the page alone: {:?}", browser.requests());
        }
    }
    assert_eq!((&grounds[0], &grounds[2]), (&grounds[1], &grounds[3]));
    assert_ne!(grounds[0], grounds[2], "light and dark differ");
}

#[test]
fn tables_are_whole_without_scripts_and_sort_with_them() {
    let Some(mut browser) = Browser::start() else { return };
    let (_folder, page) = report();
    let folded = json!({
        "RealEstate10K, 12 context views": 0, "RealEstate10K, 24 context views": 13,
        "RealEstate10K, 36 context views": 0, "ACID, 12 context views": 7, "ACID, 24 context views": 0,
        "ACID, 36 context views": 0, "Cost of a reconstruction": 7,
        "GlobalSplat by its number of Gaussians, RealEstate10K": 5,
        "GlobalSplat with one part changed, RealEstate10K": 5, "6 further scenes without pictures": 6,
    });
    let headings = "[...document.querySelectorAll('thead th, tbody th')].every((th) => ['col', 'row'].includes(th.scope))";
    for scripts_off in [true, false] {
        browser.call("Emulation.setScriptExecutionDisabled", json!({"value": scripts_off}));
        browser.set_viewport(1280, "light", "screen");
        browser.open(&page);
        assert_eq!(browser.evaluate(ROWS), folded);
        assert_eq!(browser.evaluate(headings), true);
        let buttons = browser.evaluate("document.querySelectorAll('thead button').length");
        assert_eq!(buttons == 0, scripts_off, "no button that does nothing");
        // In print, everything is unfolded and the background is white, whatever the screen's scheme.
        browser.set_viewport(1280, "dark", "print");
        let printed = browser.evaluate(ROWS);
        let counts: Vec<u64> =
            printed.as_object().expect("tables").values().filter_map(Value::as_u64).collect();
        assert_eq!(
            (counts.len(), counts.iter().sum::<u64>()),
            (10, 12 + 13 + 12 + 7 + 6 + 6 + 7 + 5 + 5 + 6)
        );
        assert_eq!(browser.evaluate("getComputedStyle(document.body).backgroundColor"), "rgb(255, 255, 255)");
        assert_eq!(strings(&browser.evaluate(FAINT)["faint"]), [""; 0]);
    }
    browser.set_viewport(1280, "light", "screen");
    let sorted = |browser: &mut Browser, column: usize| {
        browser.evaluate(&format!(
            "(() => {{
                const table = [...document.querySelectorAll('table')].find((t) => t.caption.textContent.startsWith('ACID, 12'));
                table.tHead.rows[0].cells[{column}].querySelector('button').click();
                return [...table.tBodies[0].rows].map((row) => row.cells[{column}].textContent.trim());
            }})()"
        ))
    };
    let by_name = sorted(&mut browser, 0);
    assert_eq!(strings(&by_name)[1..], ["C3G", "DepthSplat", "GGN", "GlobalSplat16K", "LVSM", "Zpressor"]);
    let by_lpips = sorted(&mut browser, 4);
    assert_eq!(strings(&by_lpips), ["0.332", "0.295", "0.220", "0.207", "0.142", "0.140", "absent"]);
    let by_lpips = sorted(&mut browser, 4);
    assert_eq!(strings(&by_lpips), ["0.140", "0.142", "0.207", "0.220", "0.295", "0.332", "absent"]);
}
