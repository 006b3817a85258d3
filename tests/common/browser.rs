//! A real browser, headless and without network access, for tests of pages.
//!
//! Communication is by the DevTools protocol over two pipes (`--remote-debugging-pipe`): a JSON object, then a zero byte.

use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Timeout after which an unresponsive browser counts as hung.
const TIMEOUT: Duration = Duration::from_secs(60);

pub struct Browser {
    process: Child,
    requests: ChildStdin,
    messages: Receiver<Value>,
    last_id: u64,
    page: Option<String>,
    /// Events of the page since it was opened.
    events: Vec<Value>,
    _profile: TempDir,
}

/// Returns the browser that `CHROME` names, or one on the path.
fn find() -> Option<PathBuf> {
    if let Some(path) = std::env::var_os("CHROME") {
        return Some(path.into());
    }
    let path = std::env::var_os("PATH")?;
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let candidates =
        names.iter().flat_map(|name| std::env::split_paths(&path).map(move |dir| dir.join(name)));
    candidates.into_iter().find(|file| file.is_file())
}

impl Browser {
    /// Starts a browser with one empty page. Without a browser, skips the test.
    pub fn start() -> Option<Self> {
        let Some(program) = find() else {
            let why = "no chromium, chromium-browser or google-chrome is on the path; set CHROME";
            super::skip("a browser", why);
            return None;
        };
        let profile = tempfile::tempdir().expect("a folder");
        // The pipes are file descriptors 3 and 4; the shell redirects standard input and output to them.
        let mut process = Command::new("sh")
            .args(["-c", r#"exec "$0" "$@" 3<&0 4>&1 </dev/null >/dev/null 2>&1"#])
            .arg(&program)
            .args([
                "--remote-debugging-pipe",
                "--headless",
                "--no-sandbox",
                // WebGL on the CPU, since test machines need not have a GPU.
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--disable-quic",
            ])
            .args(["--no-first-run", "--disable-background-networking", "--disable-component-update"])
            .args(["--disable-sync", "--host-resolver-rules=MAP * ~NOTFOUND"])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a shell");
        let requests = process.stdin.take().expect("a pipe");
        let answers = BufReader::new(process.stdout.take().expect("a pipe"));
        let (sender, messages) = channel();
        std::thread::spawn(move || {
            for message in answers.split(0) {
                let Ok(message) = message else { break };
                let _ = sender.send(serde_json::from_slice(&message).expect("JSON"));
            }
        });
        let mut browser = Browser {
            process,
            requests,
            messages,
            last_id: 0,
            page: None,
            events: vec![],
            _profile: profile,
        };
        let target = browser.call("Target.createTarget", json!({"url": "about:blank"}));
        let attach = json!({"targetId": target["targetId"], "flatten": true});
        let session = browser.call("Target.attachToTarget", attach)["sessionId"].clone();
        browser.page = Some(session.as_str().expect("a session").into());
        for domain in ["Page", "Runtime", "Log", "Network"] {
            browser.call(&format!("{domain}.enable"), json!({}));
        }
        let offline = json!({"offline": true, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0});
        browser.call("Network.emulateNetworkConditions", offline);
        Some(browser)
    }

    /// Calls a method of the protocol.
    pub fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.last_id += 1;
        let mut request = json!({"id": self.last_id, "method": method, "params": parameters});
        if let Some(page) = &self.page {
            request["sessionId"] = page.as_str().into();
        }
        self.requests.write_all(request.to_string().as_bytes()).expect("a browser that listens");
        self.requests.write_all(&[0]).expect("a browser that listens");
        loop {
            let mut message = self.next_message(method);
            if message["id"] == self.last_id {
                assert!(message["error"].is_null(), "{method}: {}", message["error"]);
                return message["result"].take();
            }
            self.events.push(message);
        }
    }

    fn next_message(&self, during: &str) -> Value {
        self.messages.recv_timeout(TIMEOUT).unwrap_or_else(|e| panic!("no answer to {during}: {e}"))
    }

    /// Opens a file and waits until it is shown.
    pub fn open(&mut self, file: &Path) {
        let file = file.canonicalize().expect("a file");
        self.events.clear();
        self.call("Page.navigate", json!({"url": format!("file://{}", file.display())}));
        while !self.events.iter().any(|event| event["method"] == "Page.loadEventFired") {
            let event = self.next_message("loading");
            self.events.push(event);
        }
    }

    /// Sets the viewport and media: `width` in pixels; `scheme` is `light` or `dark`; `media` is `screen` or `print`.
    pub fn set_viewport(&mut self, width: u32, scheme: &str, media: &str) {
        let size = json!({"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": false});
        self.call("Emulation.setDeviceMetricsOverride", size);
        let feature = json!({"name": "prefers-color-scheme", "value": scheme});
        self.call("Emulation.setEmulatedMedia", json!({"media": media, "features": [feature]}));
    }

    /// Returns the value of a JavaScript expression in the page.
    pub fn evaluate(&mut self, expression: &str) -> Value {
        let request = json!({"expression": expression, "returnByValue": true, "awaitPromise": true});
        let mut answer = self.call("Runtime.evaluate", request);
        assert!(answer["exceptionDetails"].is_null(), "{expression}: {}", answer["exceptionDetails"]);
        answer["result"]["value"].take()
    }

    /// Returns the errors that the page reported since it was opened.
    pub fn errors(&self) -> Vec<&Value> {
        let is_error = |event: &&Value| match event["method"].as_str() {
            Some("Runtime.exceptionThrown") => true,
            Some("Runtime.consoleAPICalled") => event["params"]["type"] == "error",
            Some("Log.entryAdded") => event["params"]["entry"]["level"] == "error",
            _ => false,
        };
        self.events.iter().filter(is_error).collect()
    }

    /// Returns the URLs that the page requested since it was opened, including itself, excluding data URLs.
    pub fn requests(&self) -> Vec<&str> {
        let sent = self.events.iter().filter(|event| event["method"] == "Network.requestWillBeSent");
        let urls = sent.filter_map(|event| event["params"]["request"]["url"].as_str());
        urls.filter(|url| !url.starts_with("data:")).collect()
    }
}

impl Drop for Browser {
    /// Closes the browser gracefully, so that none of its processes still writes when its profile is removed.
    fn drop(&mut self) {
        let _ = self.requests.write_all(b"{\"id\": 0, \"method\": \"Browser.close\"}\0");
        let deadline = Instant::now() + Duration::from_secs(10);
        while matches!(self.process.try_wait(), Ok(None)) && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(20));
        }
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
