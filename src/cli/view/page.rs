//! The page: HTML around the viewer that `web/` bundles, with all its data.

use super::contents::contents;
use crate::data::Capture;
use crate::error::Error;
use crate::io::{
    ShLimits, Splat, WriteOptions, check_writable_file, fit_splat, parent_of, write_file, write_local_splat,
};
use crate::scene::{Camera, Gaussians};
use anyhow::Result;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use glam::DVec3;
use maud::{DOCTYPE, Markup, PreEscaped, html};
use serde_json::Value;
use std::path::Path;

/// Viewer bundled from `web/` when this program was built; empty if npm wasn't available.
const VIEWER: &str = include_str!(concat!(env!("OUT_DIR"), "/page.js"));
const STYLE: &str = include_str!("page.css");
/// Content security policy without network access: the page contains all it needs. Spark's sorting runs in a worker and in
/// WebAssembly, both part of the script.
const POLICY: &str = "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; worker-src blob:; \
    connect-src data: blob:; img-src data: blob:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'";

/// Returns `true` if this program was built with the viewer, which requires npm.
pub fn has_viewer() -> bool {
    !VIEWER.is_empty()
}

/// Checks that this program has the viewer, and that a page can be written to `path` if it is given. Call it before the work.
///
/// # Errors
/// A program that was built without npm, or a path that can't be written to.
pub fn check_writable(path: Option<&Path>) -> Result<()> {
    if !has_viewer() {
        return Err(Error::request(
            "this program was built without the viewer that pages need: install Node.js 20 or newer with npm, and run make build",
        )
        .into());
    }
    path.map_or(Ok(()), |path| Ok(check_writable_file(path)?))
}

/// Writes an interactive page of `gaussians` of one scene, whose means are relative to `origin`, with the photos of `capture`, as one file
/// at `path`.
///
/// # Errors
/// Photos that can't be read, or a failed write.
pub fn write_page(
    path: &Path,
    name: &str,
    gaussians: &Gaussians,
    origin: DVec3,
    capture: Option<&Capture>,
) -> Result<()> {
    let frame = gaussians.local_frame(origin);
    let local = gaussians.to_local(&frame, origin);
    let contents = contents(&local, capture, &frame)?;
    let cameras = frame.cameras_to_local(&capture.map(Capture::cameras).unwrap_or_default());
    let spz = spz(parent_of(path), &local.to_splat(DVec3::ZERO)?, &cameras)?;
    let text = page(name, &contents, &spz).into_string();
    Ok(write_file(path, text)?)
}

/// Encodes the splat compactly as SPZ, with colors within the range that viewers can show, through a temporary file in `folder`.
fn spz(folder: &Path, splat: &Splat, cameras: &[Camera]) -> Result<Vec<u8>> {
    let temporary = tempfile::tempdir_in(folder).map_err(Error::write(folder))?;
    let file = temporary.path().join("scene.spz");
    let fitted = fit_splat(&file, splat, &ShLimits::of_viewers(splat.sh_degree), cameras)?;
    // Spark doesn't read newer versions.
    write_local_splat(&file, &fitted, &WriteOptions { spz_version: 3 })?;
    Ok(std::fs::read(file)?)
}

/// Escapes JSON so that it can't end the script element that contains it.
fn in_script(json: &str) -> PreEscaped<String> {
    PreEscaped(json.replace('<', "\\u003c"))
}

fn page(name: &str, contents: &Value, spz: &[u8]) -> Markup {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta http-equiv="Content-Security-Policy" content=(POLICY);
                meta name="viewport" content="width=device-width, initial-scale=1, viewport-fit=cover";
                meta name="color-scheme" content="dark";
                meta name="generator" content={ "GlobalSplat " (env!("CARGO_PKG_VERSION")) };
                title { (name) }
                style { (PreEscaped(STYLE)) }
            }
            body data-state="loading" {
                (depth_colors())
                canvas #canvas tabindex="0" aria-label="The scene. Arrow keys and W, A, S, D walk." {}
                div #compare hidden {
                    img #photo alt="The photo from here" draggable="false";
                    input #share type="range" min="0" max="1" step="any" value="0" aria-label="Photo to the left, picture to the right";
                }
                p #measurement role="status" hidden { b #distance {} code #length {} }
                p #message role="status" { "Loading the scene…" }
                noscript { p { "This page needs JavaScript; it loads none from elsewhere." } }
                header {
                    h1 { (name) }
                    nav aria-label="View" {
                        div role="group" aria-label="Shown" {
                            button #color type="button" aria-pressed="true" title="1" { "Color" }
                            button #depth type="button" aria-pressed="false" title="2" { "Depth" }
                            button #centers type="button" aria-pressed="false" title="3" { "Centers" }
                        }
                        button #cameras type="button" aria-pressed="false" title="C" { "Cameras" }
                        button #measure type="button" aria-pressed="false" title="M" { "Measure" }
                        button #help-button type="button" aria-haspopup="dialog" title="?" { "Help" }
                    }
                }
                footer {
                    div #path {
                        button #play type="button" aria-pressed="false" title="Space" { "Play" }
                        input #along type="range" min="0" max="1" step="any" value="0" aria-label="Along the cameras' path";
                    }
                    div #strip role="group" aria-label="Photos to jump to" {}
                }
                (help())
                script #scene type="application/json" { (in_script(&contents.to_string())) }
                script #splat type="text/plain" { (PreEscaped(STANDARD.encode(spz))) }
                script { (PreEscaped(VIEWER.replace("</script", "<\\/script"))) }
            }
        }
    }
}

fn help() -> Markup {
    let keys = [
        ("W A S D, arrows", "walk and turn; R and F up and down, Shift faster"),
        ("Drag, wheel", "look around, go forward and back; right button or two fingers: aside"),
        (", and .", "jump to the photo before or after"),
        ("Space", "play along the cameras' path"),
        ("1, 2, 3", "color, depth, the Gaussians' centers"),
        ("C", "cameras with their photos"),
        (
            "M",
            "measure: two clicks on the splat give their distance, and below it the option of `convert` that scales the splat to METRES",
        ),
        ("H", "hide the controls"),
        ("?", "this help"),
    ];
    html! {
        dialog #help aria-label="Help" {
            dl { @for (key, does) in keys { div { dt { (key) } dd { (does) } } } }
            p { "At a photo's camera the slider draws the photo over the picture." }
            form method="dialog" { button { "Close" } }
        }
    }
}

/// Returns an SVG filter that maps grayscale depth to the colors of `render --depth`, and keeps empty pixels black.
fn depth_colors() -> Markup {
    let colors = crate::render::depth_colors();
    let table = |channel: usize| -> String {
        let values = colors[1..].iter().map(|color| format!(" {:.3}", color[channel]));
        std::iter::once("0".into()).chain(values).collect()
    };
    html! {
        svg width="0" height="0" aria-hidden="true" {
            filter #depth-colors color-interpolation-filters="sRGB" {
                feComponentTransfer {
                    feFuncR type="table" tableValues=(table(0)) {}
                    feFuncG type="table" tableValues=(table(1)) {}
                    feFuncB type="table" tableValues=(table(2)) {}
                }
            }
        }
    }
}
