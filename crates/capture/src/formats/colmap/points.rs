//! 3D points of a COLMAP model.

use super::fields::{ByteReader, WordReader, is_comment};
use crate::capture::Capture;
use glam::DVec3;
use globalsplat_files::{Error, Result, read_text};
use std::path::Path;

/// A point on the surface of the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Position in the capture's world coordinates.
    pub position: DVec3,
    /// RGB color, values in [0, 1].
    pub color: [f32; 3],
}

/// Returns the points of the COLMAP model that `capture` was read from. Returns none if the capture has another format or the model
/// has no file of points.
///
/// # Errors
/// Fails if the file violates the format.
pub fn read_points(capture: &Capture) -> Result<Vec<Point>> {
    let images = capture.file();
    let form =
        images.file_name().and_then(|name| name.to_str()).and_then(|name| name.strip_prefix("images."));
    let file = images.with_file_name(format!("points3D.{}", form.unwrap_or_default()));
    match form {
        Some("bin") if file.is_file() => {
            Ok(read_points_binary(&file)?.into_iter().map(|(point, _)| point).collect())
        }
        Some("txt") if file.is_file() => read_points_text(&file),
        _ => Ok(vec![]),
    }
}

/// Reads lines of the form POINT3D_ID X Y Z R G B ERROR, followed by the views that see the point.
fn read_points_text(file: &Path) -> Result<Vec<Point>> {
    let text = read_text(file)?;
    let mut points = vec![];
    for (number, line) in (1..).zip(text.lines()).filter(|(_, line)| !is_comment(line)) {
        let mut words = WordReader { file, number, rest: line };
        let id: u64 = words.parse("POINT3D_ID", "a whole number")?;
        let mut position = [0.; 3];
        for (value, name) in position.iter_mut().zip(["X", "Y", "Z"]) {
            *value = words.parse(name, "a number")?;
        }
        let mut color = [0u8; 3];
        for (value, name) in color.iter_mut().zip(["R", "G", "B"]) {
            *value = words.parse(name, "a whole number from 0 to 255")?;
        }
        points.push(point(file, id, position, color)?);
    }
    Ok(points)
}

/// Reads the number of points (u64), then for each point: id (u64), position (f64), color (u8), error (f64), and the number of
/// views that see it (u64), each two ids (u32). Returns the points and their errors.
pub fn read_points_binary(file: &Path) -> Result<Vec<(Point, f64)>> {
    const VIEW: usize = 8;
    const MIN_ENTRY_BYTES: usize = 8 + 3 * 8 + 3 + 8 + 8;
    let contents = std::fs::read(file).map_err(Error::read(file))?;
    let mut bytes = ByteReader { file, contents: &contents, at: 0 };
    let mut points = vec![];
    for i in 0..bytes.count("the number of points", MIN_ENTRY_BYTES)? {
        let id = u64::from_le_bytes(bytes.take(|| format!("the id of point {i}, counted from 0,"))?);
        let mut position = [0.; 3];
        for value in &mut position {
            *value = bytes.number(|| format!("the position of point {id}"))?;
        }
        let color = bytes.take(|| format!("the color of point {id}"))?;
        let error = bytes.number(|| format!("the error of point {id}"))?;
        let views = bytes.count(&format!("the number of views of point {id}"), VIEW)?;
        bytes.at += views * VIEW;
        points.push((point(file, id, position, color)?, error));
    }
    bytes.end()?;
    Ok(points)
}

fn point(file: &Path, id: u64, position: [f64; 3], color: [u8; 3]) -> Result<Point> {
    let position = DVec3::from_array(position);
    if !position.is_finite() {
        let found = position.to_string();
        return Err(Error::input(file, format!("the position of point {id}"), found, "finite numbers"));
    }
    Ok(Point { position, color: color.map(|value| f32::from(value) / 255.) })
}
