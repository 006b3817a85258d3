//! Captures in the formats of other tools, written here from the formats' documentation.

use glam::{DMat4, DQuat, DVec3, DVec4, EulerRot};
use globalsplat_capture::{Camera, Capture, Intrinsics, open_capture, pose_to_rows};
use serde_json::{Value, json};
use std::path::Path;

/// Width of the photos in pixels.
pub const WIDTH: u32 = 24;
/// Height of the photos in pixels.
pub const HEIGHT: u32 = 16;

/// Returns five cameras in general position.
pub fn cameras() -> Vec<Camera> {
    let intrinsics = Intrinsics { fx: 21.5, fy: 20.25, cx: 11.75, cy: 8.5 };
    (0..5)
        .map(|i| {
            let t = f64::from(i);
            let rotation = DQuat::from_euler(EulerRot::XYZ, 0.3 + 0.9 * t, 1.1 - 0.7 * t, 2.3 * t);
            let c2w = DMat4::from_rotation_translation(rotation, DVec3::new(t, 0.5 * t * t, -2. * t));
            Camera { intrinsics, c2w, width: WIDTH, height: HEIGHT }
        })
        .collect()
}

/// Returns the names of the photos of [`cameras`].
pub fn names() -> Vec<String> {
    (0..5).map(|i| format!("{i:03}.png")).collect()
}

/// Returns the paths of photos called `names` in the folder `images`.
pub fn in_images(names: &[String]) -> Vec<String> {
    names.iter().map(|name| format!("images/{name}")).collect()
}

/// Checks that `found` has the cameras `expected`, up to rounding.
pub fn assert_same_cameras(found: &Capture, expected: &[Camera]) {
    assert_eq!(found.len(), expected.len());
    for (a, b) in found.cameras().iter().zip(expected) {
        assert_eq!((a.width, a.height), (b.width, b.height));
        let (k, l) = (a.intrinsics.to_rows(), b.intrinsics.to_rows());
        assert!(k.iter().zip(l).all(|(a, b)| (a - b).abs() < 1e-9), "{k:?} {l:?}");
        assert!(a.c2w.abs_diff_eq(b.c2w, 1e-9), "{} {}", a.c2w, b.c2w);
    }
}

/// Returns the contents of a `transforms.json`: OpenGL axes, the lens shared by all frames.
pub fn transforms(images: &[String], cameras: &[Camera]) -> Value {
    let k = cameras[0].intrinsics;
    let frames: Vec<Value> = images
        .iter()
        .zip(cameras)
        .map(|(image, camera)| {
            let opengl = camera.c2w * DMat4::from_diagonal(DVec4::new(1., -1., -1., 1.));
            let rows: Vec<Vec<f64>> = pose_to_rows(&opengl).chunks(4).map(<[f64]>::to_vec).collect();
            json!({"file_path": image, "transform_matrix": rows})
        })
        .collect();
    json!({
        "w": cameras[0].width, "h": cameras[0].height, "aabb_scale": 4,
        "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "frames": frames,
    })
}

/// Returns the world-to-camera pose: quaternion (w, x, y, z) and translation.
fn colmap_pose(camera: &Camera) -> [f64; 7] {
    let w2c = camera.c2w.inverse();
    let ([x, y, z, w], t) = (DQuat::from_mat4(&w2c).to_array(), w2c.w_axis);
    [w, x, y, z, t.x, t.y, t.z]
}

/// Writes cameras.txt and images.txt to `folder`: one camera, whose model and parameters are `lens`.
pub fn write_colmap_text(folder: &Path, names: &[String], cameras: &[Camera], lens: &str) {
    std::fs::create_dir_all(folder).unwrap();
    let (Camera { width, height, .. }, (model, parameters)) = (cameras[0], lens.split_once(' ').unwrap());
    let text = format!("# Camera list\n#   CAMERA_ID, MODEL\n7 {model} {width} {height} {parameters}\n");
    std::fs::write(folder.join("cameras.txt"), text).unwrap();
    let mut text = String::from("# Image list with two lines of data per image:\n");
    for (i, (name, camera)) in names.iter().zip(cameras).enumerate().rev() {
        let pose = colmap_pose(camera).map(|v| v.to_string()).join(" ");
        let points = if i % 2 == 0 { "" } else { "1.5 2.5 -1 10.25 3 12" };
        text += &format!("{} {pose} 7 {name}\n{points}\n", i + 1);
    }
    std::fs::write(folder.join("images.txt"), text).unwrap();
}

/// Returns a pinhole lens, `PINHOLE fx fy cx cy`.
pub fn pinhole(camera: &Camera) -> String {
    let k = camera.intrinsics;
    format!("PINHOLE {} {} {} {}", k.fx, k.fy, k.cx, k.cy)
}

/// Writes cameras.bin and images.bin to `folder`: one camera, a pinhole.
pub fn write_colmap_binary(folder: &Path, names: &[String], cameras: &[Camera]) {
    std::fs::create_dir_all(folder).unwrap();
    let (width, height, k) = (cameras[0].width, cameras[0].height, cameras[0].intrinsics);
    let mut bytes = vec![];
    bytes.extend(1u64.to_le_bytes());
    bytes.extend(7u32.to_le_bytes());
    bytes.extend(1i32.to_le_bytes());
    bytes.extend(u64::from(width).to_le_bytes());
    bytes.extend(u64::from(height).to_le_bytes());
    bytes.extend([k.fx, k.fy, k.cx, k.cy].iter().flat_map(|v| v.to_le_bytes()));
    std::fs::write(folder.join("cameras.bin"), bytes).unwrap();
    let mut bytes = vec![];
    bytes.extend((names.len() as u64).to_le_bytes());
    for (i, (name, camera)) in names.iter().zip(cameras).enumerate().rev() {
        bytes.extend((i as u32 + 1).to_le_bytes());
        bytes.extend(colmap_pose(camera).iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend(7u32.to_le_bytes());
        bytes.extend(name.as_bytes());
        bytes.push(0);
        let points = i as u64 % 3;
        bytes.extend(points.to_le_bytes());
        for _ in 0..points {
            bytes.extend(1.5f64.to_le_bytes());
            bytes.extend(2.5f64.to_le_bytes());
            bytes.extend(u64::MAX.to_le_bytes());
        }
    }
    std::fs::write(folder.join("images.bin"), bytes).unwrap();
}

/// Format in which a `cameras.json` capture is rewritten.
#[derive(Debug, Clone, Copy)]
pub enum Format {
    /// nerfstudio's `transforms.json`.
    Transforms,
    /// A COLMAP model in text files.
    ColmapText,
    /// A COLMAP model in binary files.
    ColmapBinary,
}

/// Converts the `cameras.json` capture in `folder` to another format, and removes the `cameras.json`.
pub fn rewrite(folder: &Path, format: Format) {
    let capture = open_capture(folder).unwrap();
    let images: Vec<String> = capture.names().map(String::from).collect();
    let names: Vec<String> = images.iter().map(|image| image.replace("images/", "")).collect();
    let (cameras, model) = (capture.cameras(), folder.join("sparse/0"));
    match format {
        Format::Transforms => {
            let file = folder.join("transforms.json");
            std::fs::write(file, transforms(&images, &cameras).to_string()).unwrap();
        }
        Format::ColmapText => write_colmap_text(&model, &names, &cameras, &pinhole(&cameras[0])),
        Format::ColmapBinary => write_colmap_binary(&model, &names, &cameras),
    }
    std::fs::remove_file(folder.join("cameras.json")).unwrap();
}

/// Adds points to a COLMAP model: `positions` has x, y and z of each; all have the color (255, 0, 51).
pub fn write_points(model: &Path, format: Format, positions: &[f64]) {
    if let Format::ColmapText = format {
        let lines = positions.chunks(3).enumerate().map(|(i, p)| {
            let views = if i % 2 == 0 { "" } else { " 1 17 2 4" };
            format!("{} {} {} {} 255 0 51 0.75{views}\n", i + 1, p[0], p[1], p[2])
        });
        let text: String = ["# 3D point list\n".to_string()].into_iter().chain(lines).collect();
        return std::fs::write(model.join("points3D.txt"), text).unwrap();
    }
    let mut bytes = vec![];
    bytes.extend((positions.len() as u64 / 3).to_le_bytes());
    for (i, p) in positions.chunks(3).enumerate() {
        bytes.extend((i as u64 + 1).to_le_bytes());
        bytes.extend(p.iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend([255, 0, 51]);
        bytes.extend(0.75f64.to_le_bytes());
        bytes.extend((i as u64 % 3).to_le_bytes());
        bytes.extend(vec![7u8; i % 3 * 8]);
    }
    std::fs::write(model.join("points3D.bin"), bytes).unwrap();
}
