//! `cameras.json` folders: {"image_shape": [H, W], "views": [{"image", "intrinsic" 3×3 in pixels, "c2w" 4×4}]}.

use super::capture::{Capture, Frame, Photo, check_cameras, folder_name};
use super::distortion::Distortion;
use crate::error::{Error, Result};
use crate::io::write_atomically;
use crate::scene::{Camera, Intrinsics, pose_to_rows};
use glam::DMat4;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// By which a capture of this format is recognized.
pub(super) const FILE_NAME: &str = "cameras.json";

#[derive(Serialize, Deserialize)]
struct File {
    image_shape: [u32; 2],
    views: Vec<ViewEntry>,
}

#[derive(Serialize, Deserialize)]
struct ViewEntry {
    #[serde(default)]
    image: String,
    intrinsic: Vec<Vec<Number>>,
    c2w: Vec<Vec<Number>>,
}

/// Python writes NaN and Infinity, which JSON doesn't know: they come as null and are found by the checks on cameras.
type Number = Option<f64>;

/// Reads the capture that `file` describes.
pub(super) fn read(file: &Path) -> Result<Capture> {
    let parsed = parse(file)?;
    let root = file.parent().unwrap_or(Path::new("."));
    let cameras = cameras(file, &parsed)?;
    let mut frames = vec![];
    for (i, (view, camera)) in parsed.views.into_iter().zip(cameras).enumerate() {
        let image = root.join(&view.image);
        if view.image.is_empty() || !image.is_file() {
            let expected = "the path of an image beside it";
            return Err(Error::input(
                file,
                format!("image of view {i}"),
                format!("{:?}, which is not there", view.image),
                expected,
            ));
        }
        frames.push(Frame {
            photo: Photo::File(image),
            name: view.image,
            camera,
            distortion: Distortion::default(),
        });
    }
    Capture::new(folder_name(root), file.to_owned(), frames)
}

/// Reads the cameras alone.
pub(super) fn read_cameras(file: &Path) -> Result<Vec<Camera>> {
    let cameras = cameras(file, &parse(file)?)?;
    check_cameras(file, cameras.iter())?;
    Ok(cameras)
}

/// Writes a `cameras.json` at `file`; `images` are paths relative to its folder. All cameras have one size.
///
/// # Errors
/// The system's refusal to write.
pub fn write_cameras_json(file: &Path, images: &[String], cameras: &[Camera]) -> Result<()> {
    let views = images.iter().zip(cameras).map(|(image, camera)| ViewEntry {
        image: image.clone(),
        intrinsic: rows(&camera.intrinsics.to_rows(), 3),
        c2w: rows(&pose_to_rows(&camera.c2w), 4),
    });
    let image_shape = cameras.first().map_or([0, 0], |camera| [camera.height, camera.width]);
    let contents = File { image_shape, views: views.collect() };
    let json = serde_json::to_vec_pretty(&contents).expect("numbers and strings");
    write_atomically(file, |writer| writer.write_all(&json).map_err(Error::write(file)))
}

fn rows(values: &[f64], width: usize) -> Vec<Vec<Number>> {
    values.chunks(width).map(|row| row.iter().copied().map(Some).collect()).collect()
}

fn parse(file: &Path) -> Result<File> {
    let text = std::fs::read_to_string(file).map_err(Error::read(file))?;
    serde_json::from_str(&null_for_not_a_number(&text)).map_err(|e| {
        let expected = "{\"image_shape\": [H, W], \"views\": [{\"image\", \"intrinsic\", \"c2w\"}]}";
        Error::input(file, "the file", format!("not a description of cameras ({e})"), expected)
    })
}

fn cameras(file: &Path, parsed: &File) -> Result<Vec<Camera>> {
    let [height, width] = parsed.image_shape;
    if width == 0 || height == 0 {
        return Err(Error::input(
            file,
            "image_shape",
            format!("[{height}, {width}]"),
            "a height and a width",
        ));
    }
    let matrix = |rows: &[Vec<Number>], size: usize, field: String| -> Result<Vec<f64>> {
        if rows.len() != size || rows.iter().any(|row| row.len() != size) {
            let found =
                format!("{} rows of {:?} numbers", rows.len(), rows.iter().map(Vec::len).collect::<Vec<_>>());
            return Err(Error::input(file, field, found, format!("a {size}×{size} matrix")));
        }
        Ok(rows.iter().flatten().map(|v| v.unwrap_or(f64::NAN)).collect())
    };
    parsed
        .views
        .iter()
        .enumerate()
        .map(|(i, view)| {
            let k = matrix(&view.intrinsic, 3, format!("intrinsic of view {i}"))?;
            let c2w = matrix(&view.c2w, 4, format!("c2w of view {i}"))?;
            Ok(Camera {
                intrinsics: Intrinsics { fx: k[0], fy: k[4], cx: k[2], cy: k[5] },
                c2w: DMat4::from_cols_slice(&c2w).transpose(),
                width,
                height,
            })
        })
        .collect()
}

/// Replaces NaN, Infinity and −Infinity outside of strings.
pub(super) fn null_for_not_a_number(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    let (mut in_string, mut escaped) = (false, false);
    while let Some(c) = rest.chars().next() {
        if !in_string
            && let Some(token) = ["NaN", "Infinity", "-Infinity"].iter().find(|t| rest.starts_with(**t))
        {
            out.push_str("null");
            rest = &rest[token.len()..];
            continue;
        }
        match c {
            '"' if !escaped => in_string = !in_string,
            _ => {}
        }
        escaped = in_string && c == '\\' && !escaped;
        out.push(c);
        rest = &rest[c.len_utf8()..];
    }
    out
}

#[cfg(test)]
mod tests {
    use super::null_for_not_a_number;

    #[test]
    fn only_numbers_are_replaced() {
        let text = r#"{"NaN \" NaN": [NaN, -Infinity, 1.5], "b": Infinity}"#;
        assert_eq!(null_for_not_a_number(text), r#"{"NaN \" NaN": [null, null, 1.5], "b": null}"#);
    }
}
