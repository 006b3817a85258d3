//! Captures of a small room made of Gaussians. The splat of this scene is known exactly, which allows testing everything without photos.

use glam::{DMat4, DQuat, DVec3};
use globalsplat::data::write_cameras_json;
use globalsplat::io::{Splat, write_png, write_splat};
use globalsplat::render::render_views;
use globalsplat::scene::{Camera, Gaussians, ImageSize, Intrinsics};
use globalsplat_splat_file::SH_C0;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::Path;

/// Distance between the Gaussians of a surface, in metres.
const SPACING: f64 = 0.06;

/// Writes a capture of the room of `seed` at `path`: `cameras.json`, `frames` photos of `size` in `images`, and the splat, `truth.ply`.
pub fn write_room(path: &Path, seed: u64, frames: usize, size: ImageSize) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let splat = surfaces(&mut random);
    let cameras = walk(&mut random, frames, size);
    let names: Vec<String> = (0..frames).map(|i| format!("images/{i:03}.png")).collect();
    std::fs::create_dir_all(path.join("images")).unwrap();
    let views = render_views(&Gaussians::from_splat(&splat), &cameras).unwrap();
    for (name, view) in names.iter().zip(views) {
        write_png(&path.join(name), &view.rgb).unwrap();
    }
    write_splat(&path.join("truth.ply"), &splat).unwrap();
    write_cameras_json(&path.join("cameras.json"), &names, &cameras).unwrap();
}

/// Writes the rooms `room_000`, … to `folder`, each with `frames` photos of `size` × `size`.
pub fn write_rooms(folder: &Path, scenes: u32, frames: u32, size: u32) {
    for scene in 0..scenes {
        let room = folder.join(format!("room_{scene:03}"));
        write_room(&room, scene.into(), frames as usize, [size, size].into());
    }
}

/// Returns cameras on a path to the right with a slight turn, looking into the room.
fn walk(random: &mut impl Rng, frames: usize, size: ImageSize) -> Vec<Camera> {
    let (width, height) = (f64::from(size.width), f64::from(size.height));
    let focal = 0.9 * width.max(height);
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: width / 2., cy: height / 2. };
    let (sway, turn) = (random.random_range(0.05..0.15), random.random_range(0.1..0.25));
    (0..frames)
        .map(|i| {
            let t = i as f64 / (frames.max(2) - 1) as f64 - 0.5;
            let eye = DVec3::new(1.2 * t, sway * (6. * t).sin(), 0.4 * t);
            let rotation = DQuat::from_rotation_y(-turn * 2. * t);
            let c2w = DMat4::from_rotation_translation(rotation, eye);
            Camera { intrinsics, c2w, width: size.width, height: size.height }
        })
        .collect()
}

/// A patch of the room's surface during construction: a flat, opaque, colored Gaussian.
struct Patch {
    mean: DVec3,
    normal: DVec3,
    color: DVec3,
}

fn surfaces(random: &mut impl Rng) -> Splat {
    let mut patches = vec![];
    let mut colors = || [(); 2].map(|()| DVec3::from_array([(); 3].map(|()| random.random_range(0.2..0.9))));
    // The back wall, floor, ceiling and two side walls, each a checkerboard of two colors.
    for (corner, along, across) in [
        (DVec3::new(-2., -1.2, 4.), DVec3::X * 4., DVec3::Y * 2.4),
        (DVec3::new(-2., 1.2, 1.), DVec3::X * 4., DVec3::Z * 3.),
        (DVec3::new(-2., -1.2, 1.), DVec3::X * 4., DVec3::Z * 3.),
        (DVec3::new(-2., -1.2, 1.), DVec3::Y * 2.4, DVec3::Z * 3.),
        (DVec3::new(2., -1.2, 1.), DVec3::Y * 2.4, DVec3::Z * 3.),
    ] {
        checkerboard(&mut patches, corner, along, across, colors());
    }
    for i in (0..4).map(f64::from) {
        let center = DVec3::new(-1.2 + 0.8 * i, 0.2 + 0.25 * (i * 1.7).sin(), 2.4 + 0.5 * (i * 2.3).cos());
        striped_sphere(&mut patches, center, 0.35, colors());
    }
    splat_of(&patches)
}

fn checkerboard(patches: &mut Vec<Patch>, corner: DVec3, along: DVec3, across: DVec3, colors: [DVec3; 2]) {
    const SQUARE: f64 = 0.4;
    let (columns, rows) = ((along.length() / SPACING) as usize, (across.length() / SPACING) as usize);
    for row in 0..rows {
        for column in 0..columns {
            let (s, t) = ((column as f64 + 0.5) * SPACING, (row as f64 + 0.5) * SPACING);
            let square = (s / SQUARE) as usize + (t / SQUARE) as usize;
            patches.push(Patch {
                mean: corner + along.normalize() * s + across.normalize() * t,
                normal: along.cross(across).normalize(),
                color: colors[square % 2],
            });
        }
    }
}

fn striped_sphere(patches: &mut Vec<Patch>, center: DVec3, radius: f64, colors: [DVec3; 2]) {
    let rings = (std::f64::consts::PI * radius / SPACING) as usize;
    for ring in 0..rings {
        let polar = std::f64::consts::PI * (ring as f64 + 0.5) / rings as f64;
        let around = (2. * std::f64::consts::PI * radius * polar.sin() / SPACING).max(3.) as usize;
        for k in 0..around {
            let azimuth = std::f64::consts::TAU * k as f64 / around as f64;
            let normal = DVec3::new(polar.sin() * azimuth.cos(), polar.cos(), polar.sin() * azimuth.sin());
            patches.push(Patch { mean: center + radius * normal, normal, color: colors[ring / 3 % 2] });
        }
    }
}

fn splat_of(patches: &[Patch]) -> Splat {
    let log_scales = [0.6 * SPACING, 0.6 * SPACING, 0.05 * SPACING].map(|scale| scale.ln() as f32);
    let quaternion = |patch: &Patch| {
        let [x, y, z, w] = DQuat::from_rotation_arc(DVec3::Z, patch.normal).as_quat().to_array();
        [w, x, y, z]
    };
    Splat::new(
        0,
        patches.iter().map(|patch| patch.mean.as_vec3().to_array()).collect(),
        vec![log_scales; patches.len()],
        patches.iter().map(quaternion).collect(),
        vec![(0.95f32 / 0.05).ln(); patches.len()],
        patches.iter().map(|patch| ((patch.color - 0.5) / SH_C0).as_vec3().to_array()).collect(),
    )
    .unwrap()
}
