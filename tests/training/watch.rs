//! `globalsplat watch`: its view of a run, its access control, and that it leaves the run's folder unchanged.

use crate::common::browser::Browser;
use crate::common::program::{arg, command, refuse, room, succeed, text, tiny_config, train};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fs::OpenOptions;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant, SystemTime};
use tempfile::TempDir;

/// Number of steps of the watched run.
const STEPS: usize = 6;

/// Returns a finished run, with images; created once. Tests that change it use a [`copy`].
fn run() -> &'static Path {
    static RUN: OnceLock<(TempDir, PathBuf)> = OnceLock::new();
    let (_, run) = RUN.get_or_init(|| {
        let (folder, capture) = room();
        let (config, run) = (tiny_config(folder.path(), &capture), folder.path().join("my <b>run"));
        let settings = ["train.log_images_every=2", "train.log_every=1", "train.validate_every=2"];
        succeed(&text(&train(&config, &run, &settings)));
        (folder, run)
    });
    run
}

/// Copies the run to another folder, where it may be changed.
fn copy() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    let copy = folder.path().join("run");
    for file in files(run()).keys() {
        let to = copy.join(file.strip_prefix(run()).expect("a file of the run"));
        std::fs::create_dir_all(to.parent().expect("a folder")).expect("a folder");
        std::fs::copy(file, to).expect("a copy");
    }
    (folder, copy)
}

/// Returns all files below a folder: their bytes, and their modification times.
fn files(folder: &Path) -> BTreeMap<PathBuf, (Vec<u8>, SystemTime)> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        match path.is_dir() {
            true => found.extend(files(&path)),
            false => {
                let written = path.metadata().and_then(|file| file.modified()).expect("a time");
                found.insert(path.clone(), (std::fs::read(path).expect("a file"), written));
            }
        }
    }
    found
}

/// Running `watch` command.
struct Watch {
    process: Child,
    port: u16,
}

impl Watch {
    fn start(run: &Path) -> Self {
        let mut process =
            command(&["watch", arg(run), "--json"]).stdout(Stdio::piped()).spawn().expect("a program");
        let mut line = String::new();
        BufReader::new(process.stdout.take().expect("a pipe")).read_line(&mut line).expect("a line");
        let report: Value = serde_json::from_str(&line).expect("JSON");
        let url = report["url"].as_str().expect("an address");
        let port = url.strip_prefix("http://127.0.0.1:").and_then(|rest| rest.strip_suffix('/'));
        Watch { process, port: port.and_then(|port| port.parse().ok()).unwrap_or_else(|| panic!("{url}")) }
    }

    /// Sends a request with this first line and this Host header; returns the head and the body of the response.
    fn ask_as(&self, first: &str, host: &str) -> (String, Vec<u8>) {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).expect("a server");
        stream.set_read_timeout(Some(Duration::from_secs(60))).expect("a time limit");
        write!(stream, "{first} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").expect("a listener");
        let mut answer = vec![];
        stream.read_to_end(&mut answer).expect("an answer");
        let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").expect("a head");
        (String::from_utf8(answer[..end].to_vec()).expect("text"), answer[end + 4..].to_vec())
    }

    fn ask(&self, first: &str) -> (String, Vec<u8>) {
        self.ask_as(first, &format!("127.0.0.1:{}", self.port))
    }

    /// Returns the status code of the response to a request.
    fn status(&self, first: &str, host: &str) -> u16 {
        let (head, _) = self.ask_as(first, host);
        head.split(' ').nth(1).and_then(|status| status.parse().ok()).unwrap_or_else(|| panic!("{head}"))
    }

    fn state(&self) -> Value {
        let (head, body) = self.ask("GET /state");
        assert!(head.starts_with("HTTP/1.1 200"), "{head}");
        assert!(body.len() < 100_000, "{} bytes", body.len());
        serde_json::from_slice(&body).expect("JSON")
    }

    /// Ends the command as Ctrl-C does, and returns the exit code.
    #[cfg(unix)]
    fn interrupt(mut self) -> Option<i32> {
        let killed =
            std::process::Command::new("kill").args(["-INT", &self.process.id().to_string()]).status();
        assert!(killed.expect("kill").success());
        let deadline = Instant::now() + Duration::from_secs(30);
        while Instant::now() < deadline {
            if let Some(status) = self.process.try_wait().expect("a child") {
                return status.code();
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        None
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Returns the points of a curve, as the run recorded them.
fn written(run: &Path, value: impl Fn(&Value) -> &Value) -> Value {
    let lines = std::fs::read_to_string(run.join("metrics.jsonl")).expect("metrics");
    let lines = lines.lines().map(|line| serde_json::from_str::<Value>(line).expect("JSON"));
    lines.filter(|line| value(line).is_number()).map(|line| json!([line["step"], value(&line)])).collect()
}

fn notices(state: &Value) -> String {
    let notices = state["notices"].as_array().expect("a list");
    notices.iter().map(|notice| notice.as_str().expect("a sentence")).collect::<Vec<_>>().join("\n")
}

#[test]
fn the_state_contains_the_recorded_metrics() {
    let run = run();
    let state = Watch::start(run).state();
    let curves = &state["curves"];
    assert_eq!(curves["psnr"].as_array().map(Vec::len), Some(STEPS));
    for (name, points) in [
        ("psnr", written(run, |line| &line["psnr"])),
        ("loss", written(run, |line| &line["loss"])),
        ("learning_rate", written(run, |line| &line["learning_rate"])),
        ("held_out", written(run, |line| &line["validation"]["psnr"])),
    ] {
        assert_eq!(curves[name], points, "{name}");
    }
    assert!(curves["held_out"].as_array().map(Vec::len) > Some(1));
    let last = &curves["loss"][STEPS - 1][1];
    assert_eq!([&state["step"], &state["steps"], &state["loss"]], [&json!(STEPS), &json!(STEPS), last]);
    assert_eq!([&state["seconds_left"], &state["notices"]], [&json!(0.), &json!([])]);
    assert!(state["samples_per_second"].as_f64() > Some(0.));
    assert_eq!(state["pictures"], json!([4, 2, 0]));
    let names: Vec<_> = state["checkpoints"].as_array().unwrap().iter().map(|kept| &kept["name"]).collect();
    assert_eq!(names, ["checkpoints/step-00000004", "checkpoints/step-00000006"]);
    let bytes = ["model.safetensors", "optimizer.safetensors"]
        .map(|name| run.join("checkpoints/step-00000006").join(name).metadata().unwrap().len());
    assert_eq!(state["checkpoints"][1]["bytes"], bytes[0] + bytes[1]);
    let best = curves["held_out"].as_array().unwrap().iter().map(|point| point[1].as_f64().unwrap());
    assert_eq!(state["best"]["psnr"], best.fold(f64::NEG_INFINITY, f64::max));
}

#[test]
fn appended_and_rewritten_metrics_are_followed() {
    let (_folder, run) = copy();
    let metrics = run.join("metrics.jsonl");
    let watch = Watch::start(&run);
    assert_eq!(watch.state()["step"], STEPS);
    let add = |text: &str| {
        let mut file = OpenOptions::new().append(true).open(&metrics).unwrap();
        file.write_all(text.as_bytes()).unwrap();
    };
    // An incomplete line is ignored until the rest is written.
    add(r#"{"step": 6, "loss": 0.5, "psnr": 3"#);
    assert_eq!(watch.state()["step"], STEPS);
    add(
        "1.5}\n{\"step\": 7, \"skipped\": true, \"loss\": null, \"psnr\": 3.5, \"scenes\": [\"a\", \"b\", \"c\", \"d\"]}\n",
    );
    let state = watch.state();
    assert_eq!([&state["step"], &state["curves"]["psnr"][STEPS]], [&json!(8), &json!([6, 31.5])]);
    assert_eq!(state["curves"]["psnr"].as_array().map(Vec::len), Some(STEPS + 1), "without the skipped step");
    let message = notices(&state);
    assert!(
        message.starts_with("1 step was skipped") && message.ends_with("step 7, and showed a, b, c, 1 more"),
        "{message}"
    );

    // A stalled run.
    let config = std::fs::read_to_string(run.join("config.toml")).unwrap();
    std::fs::write(run.join("config.toml"), config.replace("\nsteps = 6", "\nsteps = 60")).unwrap();
    let file = OpenOptions::new().append(true).open(&metrics).unwrap();
    file.set_modified(SystemTime::now() - Duration::from_secs(630)).unwrap();
    let state = watch.state();
    assert!(notices(&state).starts_with("nothing was logged for 10 min"), "{}", notices(&state));
    assert_eq!(state["steps"], 60);

    // A resumed run rewrites the file, which then grows past its previous length.
    let text = std::fs::read_to_string(&metrics).unwrap();
    let first = text.lines().next().unwrap().to_string() + "\n";
    std::fs::write(&metrics, &first).unwrap();
    assert_eq!(watch.state()["curves"]["psnr"].as_array().map(Vec::len), Some(1));
    let longer: String = (1..100).map(|step| format!("{{\"step\": {step}, \"psnr\": {step}.5}}\n")).collect();
    std::fs::write(&metrics, first + &longer).unwrap();
    let state = watch.state();
    assert_eq!([&state["step"], &state["curves"]["psnr"][99]], [&json!(100), &json!([99, 99.5])]);

    // The file is removed, and written again.
    std::fs::remove_file(&metrics).unwrap();
    let state = watch.state();
    assert_eq!([&state["step"], &state["curves"]["psnr"]], [&json!(0), &json!([])]);
    std::fs::write(&metrics, "{\"step\": 0, \"psnr\": 9.5}\nno JSON\n").unwrap();
    let state = watch.state();
    assert_eq!([&state["step"], &state["curves"]["psnr"]], [&json!(1), &json!([[0, 9.5]])]);
    assert!(notices(&state).ends_with("lines of metrics.jsonl that no run wrote: 1"), "{}", notices(&state));
}

#[test]
fn a_resumed_run_goes_on_and_its_later_pictures_are_void() {
    let (folder, capture) = room();
    let (config, run) = (tiny_config(folder.path(), &capture), folder.path().join("run"));
    let settings = |steps| vec![steps, "train.log_images_every=1", "train.log_every=1"];
    succeed(&text(&train(&config, &run, &settings("train.steps=3"))));
    let watch = Watch::start(&run);
    assert_eq!(watch.state()["pictures"], json!([2, 1, 0]));
    // Simulates a run that was killed after the checkpoint of step 2.
    std::fs::remove_dir_all(run.join("checkpoints/step-00000003")).unwrap();
    succeed(&text(&train(&config, &run, &settings("train.steps=5"))));
    let state = watch.state();
    assert_eq!([&state["step"], &state["pictures"]], [&json!(5), &json!([4, 3, 2, 1, 0])]);
    assert_eq!(state["curves"]["psnr"], written(&run, |line| &line["psnr"]));
    assert_eq!(notices(&state), "the run was resumed at step 2");
}

#[test]
fn a_long_run_fits_on_the_page() {
    let folder = tempfile::tempdir().unwrap();
    let line = |step: u64| {
        let value = f64::from(step as u32) / 3e5 + 0.1234567890123;
        format!(
            "{{\"step\": {step}, \"loss\": {value}, \"psnr\": {value}, \"learning_rate\": {value}}}\n{{\"step\": {step}, \"validation\": {{\"psnr\": {value}}}}}\n"
        )
    };
    std::fs::write(folder.path().join("metrics.jsonl"), (0..220_000).map(line).collect::<String>()).unwrap();
    let state = Watch::start(folder.path()).state();
    for name in ["psnr", "loss", "learning_rate", "held_out"] {
        let points = state["curves"][name].as_array().unwrap();
        assert!((100..=400).contains(&points.len()), "{name}: {}", points.len());
        assert_eq!(points.last().unwrap()[0], 219_999, "{name}");
    }
}

#[test]
fn requests_from_other_hosts_and_unknown_paths_are_refused() {
    let watch = Watch::start(run());
    let port = watch.port;
    for own in ["127.0.0.1", "localhost", "[::1]"] {
        assert_eq!(watch.status("GET /state", &format!("{own}:{port}")), 200, "{own}");
    }
    for host in
        ["evil.example", "127.0.0.1", "127.0.0.1.evil.example", "localhost.evil.example", "192.168.0.1"]
    {
        for host in [format!("{host}:{port}"), host.to_string()] {
            let is_own = host == format!("127.0.0.1:{port}");
            let expected = if is_own { 200 } else { 403 };
            for path in ["/", "/state", "/picture/4.png"] {
                assert_eq!(watch.status(&format!("GET {path}"), &host), expected, "{path} of {host}");
            }
        }
    }
    let own = format!("localhost:{port}");
    for method in ["POST", "PUT", "DELETE", "OPTIONS", "PATCH"] {
        assert_eq!(watch.status(&format!("{method} /state"), &own), 405, "{method}");
    }
    for path in [
        "/states",
        "/state/",
        "/picture/",
        "/picture/4",
        "/picture/1.png",
        "/picture/-4.png",
        "/picture/99999999999999999999999.png",
        "/picture/../../etc/passwd",
        "/picture/..%2f..%2fetc%2fpasswd",
        "/picture/../config.toml",
        "/../../etc/passwd",
        "/config.toml",
        "//etc/passwd",
    ] {
        assert_eq!(watch.status(&format!("GET {path}"), &own), 404, "{path}");
    }
    // Five images and the gaps between them; the query string is ignored.
    for path in ["/picture/4.png", "/picture/4.png?step=2"] {
        let (head, png) = watch.ask(&format!("GET {path}"));
        let picture = image::load_from_memory(&png).expect("a picture");
        assert!(
            head.contains("image/png") && head.contains("same-origin") && picture.width() == 5 * 32 + 4 * 4,
            "{head}"
        );
    }
    let (head, body) = watch.ask("HEAD /");
    assert!(head.starts_with("HTTP/1.1 200") && body.is_empty(), "{head}");
    assert!(head.contains("content-security-policy: default-src 'none'; script-src 'nonce-"), "{head}");
    assert!(!head.contains("unsafe"), "{head}");

    // The port is closed on other addresses of this machine. Linux has all of 127.0.0.0/8.
    #[cfg(target_os = "linux")]
    for address in ["127.0.0.2", "::1"] {
        assert!(TcpStream::connect((address, port)).is_err(), "{address}");
    }
    #[cfg(target_os = "linux")]
    assert_eq!(listening(port), ["0100007F"], "127.0.0.1 alone");
}

/// Returns the addresses on which a port is listened on, as the kernel formats them.
#[cfg(target_os = "linux")]
fn listening(port: u16) -> Vec<String> {
    let tables =
        ["/proc/net/tcp", "/proc/net/tcp6"].map(|file| std::fs::read_to_string(file).unwrap_or_default());
    let rows = tables.iter().flat_map(|table| table.lines().skip(1));
    let fields = rows.map(|row| row.split_whitespace().collect::<Vec<_>>());
    let ours = fields.filter(|fields| fields[3] == "0A" && fields[1].ends_with(&format!(":{port:04X}")));
    ours.map(|fields| fields[1].split(':').next().expect("an address").to_string()).collect()
}

#[test]
#[cfg(unix)]
fn watch_does_not_change_the_run() {
    let (_folder, run) = copy();
    let before = files(&run);
    let watch = Watch::start(&run);
    for path in ["/", "/state", "/picture/4.png", "/picture/1.png", "/state"] {
        watch.ask(&format!("GET {path}"));
        watch.ask(&format!("POST {path}"));
    }
    assert_eq!(watch.interrupt(), Some(0), "Ctrl-C is how it ends");
    assert!(before == files(&run), "something was written");

    // It neither needs the lock nor keeps anybody from training.
    let watch = Watch::start(&run);
    let lock = OpenOptions::new().read(true).write(true).open(run.join(".lock")).unwrap();
    lock.try_lock().expect("a lock that nobody holds");
    assert_eq!(watch.state()["step"], STEPS);
}

#[test]
fn what_is_no_run_is_refused_in_a_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let absent = folder.path().join("absent");
    let error = refuse(&["watch", arg(&absent)]);
    assert!(
        error
            .ends_with("absent: the run is missing, expected a folder that `globalsplat train --out` writes"),
        "{error}"
    );
    let error = refuse(&["watch", arg(folder.path())]);
    assert!(error.contains("the run is a folder without metrics.jsonl, expected"), "{error}");
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let error = refuse(&["watch", arg(run()), "--port", &port]);
    assert!(error.contains(&format!("--port is {port}, which can't be listened on")), "{error}");
}

/// Script that reports the curves, values, images and checkpoints on the page.
const SHOWN: &str = r#"(() => {
    const images = [...document.images];
    return {
        heading: document.querySelector("h1").textContent,
        lines: [...document.querySelectorAll("svg")].map((svg) => svg.querySelectorAll("polyline").length),
        points: document.querySelector("polyline")?.points.length,
        pictures: images.filter((image) => image.complete && image.naturalWidth === 176).length,
        rows: document.querySelectorAll("tbody tr").length,
        progress: document.querySelector("progress").value,
        notices: document.querySelector("[id=notices]").textContent,
        wide: document.documentElement.scrollWidth - document.documentElement.clientWidth,
        ground: getComputedStyle(document.body).backgroundColor,
        surface: getComputedStyle(document.querySelector(".card")).backgroundColor,
    };
})()"#;

/// Returns the value of the expression in the page once `is_right` accepts it.
fn wait_for(browser: &mut Browser, expression: &str, is_right: impl Fn(&Value) -> bool) -> Value {
    let deadline = Instant::now() + Duration::from_secs(60);
    loop {
        let value = browser.evaluate(expression);
        if is_right(&value) {
            return value;
        }
        assert!(Instant::now() < deadline, "{value}");
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn a_browser_shows_it_and_follows_the_run() {
    let Some(mut browser) = Browser::start() else { return };
    let watch = Watch::start(run());
    let url = format!("http://127.0.0.1:{}/", watch.port);
    let mut grounds = vec![];
    for scheme in ["light", "dark"] {
        for width in [1280, 400] {
            browser.set_viewport(width, scheme, "screen");
            browser.open_served(&url);
            let shown = wait_for(&mut browser, SHOWN, |shown| shown["pictures"] == 3);
            assert_eq!(shown["heading"], "my <b>run", "a name is text");
            assert_eq!([&shown["lines"], &shown["points"]], [&json!([2, 1, 1]), &json!(STEPS)]);
            assert_eq!(
                [&shown["rows"], &shown["progress"], &shown["notices"]],
                [&json!(3), &json!(1), &json!("")]
            );
            assert_eq!(shown["wide"], 0, "at {width}");
            grounds.push((shown["ground"].clone(), shown["surface"].clone()));
        }
    }
    assert_ne!(grounds[0].0, grounds[2].0, "light and dark differ");
    assert_ne!(grounds[0].0, grounds[0].1, "cards stand out");

    // Hovering shows values.
    let hover = r#"(() => {
        const svg = document.querySelector("svg"), area = svg.getBoundingClientRect();
        svg.dispatchEvent(new PointerEvent("pointermove", { clientX: area.left + 1, clientY: area.top + 20 }));
        return document.querySelector(".reading").textContent;
    })()"#;
    let first = written(run(), |line| &line["psnr"])[0][1].as_f64().unwrap();
    let tooltip = browser.evaluate(hover);
    let tooltip = tooltip.as_str().unwrap();
    assert!(tooltip.starts_with(&format!("in training {first:.2} dB (step 0), held out")), "{tooltip}");

    assert_eq!(browser.errors(), [&json!(null); 0]);
    let foreign: Vec<_> = browser.requests().into_iter().filter(|asked| !asked.starts_with(&url)).collect();
    assert!(foreign.is_empty(), "{foreign:?}");

    // The page follows the run without being reloaded.
    let (_folder, run) = copy();
    let watch = Watch::start(&run);
    browser.open_served(&format!("http://127.0.0.1:{}/", watch.port));
    wait_for(&mut browser, SHOWN, |shown| shown["points"] == STEPS);
    let mut file = OpenOptions::new().append(true).open(run.join("metrics.jsonl")).unwrap();
    let step = r#"{"step": 6, "psnr": 20.5}"#;
    let skipped = r#"{"step": 7, "psnr": 3.5, "skipped": true, "scenes": ["<img src=x>"]}"#;
    file.write_all(format!("{step}\n{skipped}\n").as_bytes()).unwrap();
    let shown = wait_for(&mut browser, SHOWN, |shown| shown["points"] == STEPS + 1);
    assert!(shown["notices"].as_str().unwrap().ends_with("showed <img src=x>"), "{shown}");
    assert_eq!(browser.errors(), [&json!(null); 0]);
}
