//! HTTP server of `watch`: checks requests and answers them.

use super::page;
use anyhow::{Result, bail};
use globalsplat::error::Error;
use globalsplat::train::WatchedRun;
use oxhttp::Server;
use oxhttp::model::header::{
    ALLOW, CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HOST, REFERRER_POLICY,
    X_CONTENT_TYPE_OPTIONS,
};
use oxhttp::model::{Body, Method, Request, Response, StatusCode};
use serde_json::json;
use std::io::ErrorKind;
use std::net::{Ipv4Addr, TcpListener};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// Timeout after which an idle connection is closed.
const IDLE_TIMEOUT: Duration = Duration::from_secs(30);
/// Maximum number of concurrent connections; a page keeps up to six.
const CONNECTIONS: usize = 64;
/// Maximum number of attempts: another process may take a free port before we bind it.
const TRIES: usize = 8;

const TEXT: &str = "text/plain; charset=utf-8";

/// Serves `run` for the lifetime of the process, on `port` or, if that is 0, on a free port, and returns the page's URL.
///
/// # Errors
/// A port that is in use, or that the system refuses.
pub fn serve(run: WatchedRun, port: u16) -> Result<String> {
    let run = std::sync::Arc::new(Mutex::new(run));
    for _ in 0..TRIES {
        // The server doesn't report the port it was given.
        let chosen = match port {
            0 => TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?.local_addr()?.port(),
            port => port,
        };
        let run = run.clone();
        let server = Server::new(move |request| answer(request, chosen, &run))
            .bind((Ipv4Addr::LOCALHOST, chosen))
            .with_global_timeout(IDLE_TIMEOUT)
            .with_max_concurrent_connections(CONNECTIONS);
        match server.spawn() {
            Ok(_) => return Ok(format!("http://{}:{chosen}/", Ipv4Addr::LOCALHOST)),
            Err(e) if port == 0 && e.kind() == ErrorKind::AddrInUse => {}
            Err(e) => {
                let found = format!("{chosen}, which can't be listened on ({e})");
                return Err(Error::setting("--port", found, "a free one, or 0 to have one chosen").into());
            }
        }
    }
    bail!("no free port was found in {TRIES} tries")
}

fn answer(request: &Request<Body>, port: u16, run: &Mutex<WatchedRun>) -> Response<Body> {
    if !is_meant_for_us(request, port) {
        return refuse(StatusCode::FORBIDDEN, "this page is for browsers on the machine that serves it");
    }
    if ![Method::GET, Method::HEAD].contains(request.method()) {
        let mut answer =
            refuse(StatusCode::METHOD_NOT_ALLOWED, "only GET and HEAD: nothing can be changed here");
        answer.headers_mut().insert(ALLOW, "GET, HEAD".parse().expect("two methods"));
        return answer;
    }
    // A reader that panicked left no state that isn't read again.
    let mut run = run.lock().unwrap_or_else(PoisonError::into_inner);
    let mut answer = match request.uri().path() {
        "/" => {
            let page = page::Page::new();
            let mut answer = send(StatusCode::OK, "text/html; charset=utf-8", page.html);
            let policy = page.policy.parse().expect("ASCII");
            answer.headers_mut().insert(CONTENT_SECURITY_POLICY, policy);
            answer
        }
        "/state" => match run.refresh().map_err(|e| e.to_string()).and_then(|state| {
            serde_json::to_string(&state).map_err(|e| format!("can't serialize the run's state as JSON: {e}"))
        }) {
            Ok(state) => send(StatusCode::OK, "application/json", state),
            Err(e) => {
                let error = json!({"error": e}).to_string();
                send(StatusCode::INTERNAL_SERVER_ERROR, "application/json", error)
            }
        },
        path => match step_of(path).map(|step| run.picture(step)) {
            Some(Ok(Some(png))) => send(StatusCode::OK, "image/png", png),
            Some(Err(e)) => refuse(StatusCode::INTERNAL_SERVER_ERROR, &e.to_string()),
            Some(Ok(None)) | None => refuse(StatusCode::NOT_FOUND, "there is nothing here"),
        },
    };
    if request.method() == Method::HEAD {
        *answer.body_mut() = Body::empty();
    }
    answer
}

/// Returns `true` if the request is addressed to this machine. After DNS rebinding, where a foreign host name resolves to this
/// address, the Host header has that name, and the foreign page could read the answer.
fn is_meant_for_us(request: &Request<Body>, port: u16) -> bool {
    let mut hosts = request.headers().get_all(HOST).iter();
    match (hosts.next().and_then(|host| host.to_str().ok()), hosts.next()) {
        (Some(host), None) => is_this_machine(host, port),
        _ => false,
    }
}

/// Returns `true` if the value of a Host header names this machine and `port`: names are case-insensitive, may end with a dot,
/// and without a port it is HTTP's default (RFC 9110, section 7.2).
fn is_this_machine(host: &str, port: u16) -> bool {
    const HTTP: u16 = 80;
    // An IPv6 address has colons of its own, in brackets.
    let (name, said) = match host.rsplit_once(':') {
        Some((name, said)) if !said.ends_with(']') => (name, Some(said)),
        _ => (host, None),
    };
    let said = match said {
        None | Some("") => Some(HTTP),
        Some(digits) => {
            Some(digits).filter(|d| d.bytes().all(|d| d.is_ascii_digit())).and_then(|d| d.parse().ok())
        }
    };
    let name = name.strip_suffix('.').unwrap_or(name).to_ascii_lowercase();
    said == Some(port) && ["127.0.0.1", "localhost", "[::1]"].contains(&name.as_str())
}

/// Parses `/picture/STEP.png`. The step number is the only part of a URL that reaches a file name.
fn step_of(path: &str) -> Option<u64> {
    path.strip_prefix("/picture/")?.strip_suffix(".png")?.parse().ok()
}

fn refuse(status: StatusCode, why: &str) -> Response<Body> {
    send(status, TEXT, format!("{why}\n"))
}

fn send(status: StatusCode, kind: &str, body: impl Into<Body>) -> Response<Body> {
    Response::builder()
        .status(status)
        .header(CONTENT_TYPE, kind)
        .header(X_CONTENT_TYPE_OPTIONS, "nosniff")
        .header(REFERRER_POLICY, "no-referrer")
        .header(CACHE_CONTROL, "no-store")
        // Pages of other origins may not embed our images, either.
        .header("cross-origin-resource-policy", "same-origin")
        .body(body.into())
        .expect("headers without a line's end")
}

#[cfg(test)]
mod tests {
    use super::is_this_machine;

    #[test]
    fn this_machine_is_known_by_its_names_and_the_port() {
        for host in ["127.0.0.1:8123", "localhost:8123", "LocalHost:8123", "localhost.:8123", "[::1]:8123"] {
            assert!(is_this_machine(host, 8123), "{host}");
        }
        // Browsers omit HTTP's default port.
        for host in
            ["127.0.0.1", "localhost", "LOCALHOST.", "[::1]", "localhost:", "localhost:80", "[::1]:80"]
        {
            assert!(is_this_machine(host, 80), "{host}");
        }
        for host in
            ["localhost", "[::1]", "localhost:80", "localhost:+8123", "localhost: 8123", "localhost:74659"]
        {
            assert!(!is_this_machine(host, 8123), "{host}");
        }
        for host in [
            "",
            ":80",
            ".",
            "example.org",
            "example.org:80",
            "localhost.example.org",
            "localhost..",
            "127.0.0.1.example.org",
            "::1",
            "[::1",
            "::1]",
            "127.0.0.2",
            "example.org@localhost",
            "localhost:80:80",
        ] {
            assert!(!is_this_machine(host, 80), "{host}");
        }
    }
}
