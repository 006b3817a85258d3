//! Test utilities: splats, files that other programs would write, and checks of error messages.
#![allow(dead_code)] // every test binary uses only a part

use globalsplat_splat_file::{Splat, limits_of, read_splat, write_splat};
use std::path::{Path, PathBuf};

/// Extensions of all formats that are written.
pub const ENDINGS: [&str; 7] = ["ply", "compressed.ply", "sog", "spz", "splat", "glb", "gltf"];

/// Returns the extensions of the formats that this build writes.
pub fn endings() -> impl Iterator<Item = &'static str> {
    ENDINGS.into_iter().filter(|ending| limits_of(Path::new(&format!("a.{ending}"))).is_ok())
}

/// Random numbers (SplitMix64).
pub struct Random(u64);

impl Random {
    /// Creates the generator of a seed.
    pub fn new(seed: u64) -> Self {
        Random(seed)
    }

    /// Returns a number in [0, 1).
    pub fn uniform(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((mixed ^ (mixed >> 31)) >> 40) as f32 / (1 << 24) as f32
    }

    /// Returns numbers in [-1, 1).
    pub fn symmetric<const N: usize>(&mut self) -> [f32; N] {
        std::array::from_fn(|_| 2. * self.uniform() - 1.)
    }
}

/// Returns a splat whose values are within the range of every format: coefficients within ±0.9, displayable colors.
pub fn random_splat(count: usize, degree: usize, seed: u64) -> Splat {
    let mut random = Random::new(seed);
    let (mut means, mut log_scales, mut quaternions) = (vec![], vec![], vec![]);
    let (mut opacity_logits, mut sh) = (vec![], vec![]);
    for _ in 0..count {
        let [x, y, z] = random.symmetric().map(|number: f32| 3. * number);
        means.push([x, y, z + 6.]);
        log_scales.push(random.symmetric().map(|number: f32| number - 2.));
        quaternions.push(random.symmetric());
        let opacity = random.uniform();
        opacity_logits.push((opacity / (1. - opacity)).ln());
        sh.extend((0..(degree + 1).pow(2)).map(|_| random.symmetric().map(|number: f32| 0.9 * number)));
    }
    Splat::new(degree, means, log_scales, quaternions, opacity_logits, sh).unwrap()
}

/// Writes `splat` to the file `name` and returns its path.
pub fn written(folder: &Path, name: &str, splat: &Splat) -> PathBuf {
    let path = folder.join(name);
    write_splat(&path, splat).unwrap();
    path
}

/// Returns the largest difference between two lists of numbers of the same length.
pub fn largest_error(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs()).fold(0., f64::max)
}

/// Checks that `error` contains all of `parts`.
pub fn assert_says(error: &str, parts: &[&str]) {
    for part in parts {
        assert!(error.contains(part), "{part:?} is not in: {error}");
    }
}

/// Returns the one-sentence error with which the file at `path` is refused, as a wrong request.
pub fn refused_file(path: &Path) -> String {
    let error = read_splat(path).expect_err("an invalid file");
    assert!(error.is_invalid_request(), "{error}");
    let text = error.to_string();
    assert_eq!(text.lines().count(), 1, "one sentence: {text}");
    text
}

/// Returns the error message for a file of `ending` whose bytes are changed.
pub fn refused(ending: &str, change: impl FnOnce(&mut Vec<u8>)) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = written(folder.path(), &format!("broken.{ending}"), &random_splat(300, 1, 9));
    let mut bytes = std::fs::read(&path).unwrap();
    change(&mut bytes);
    std::fs::write(&path, bytes).unwrap();
    let error = refused_file(&path);
    assert_says(&error, &[&format!("broken.{ending}: ")]);
    error
}

/// Returns the offset of the first byte after the header of a PLY.
pub fn body_of_ply(bytes: &[u8]) -> usize {
    bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11
}

/// Properties of three Gaussians in a PLY, by name.
pub type Columns = Vec<(&'static str, [f64; 3])>;

/// Returns the properties of a PLY, with the values of three Gaussians in a row.
pub fn small_gaussians() -> Columns {
    vec![
        ("x", [-0.5, 0., 0.5]),
        ("y", [0.1, -0.1, 0.2]),
        ("z", [4., 4.2, 4.4]),
        ("f_dc_0", [1., 0.5, -0.5]),
        ("f_dc_1", [-1., 1.2, 0.1]),
        ("f_dc_2", [0.3, -0.4, 0.8]),
        ("opacity", [2.; 3]),
        ("scale_0", [-1.5; 3]),
        ("scale_1", [-2.; 3]),
        ("scale_2", [-2.5; 3]),
        ("rot_0", [1., 0.5, 0.8]),
        ("rot_1", [0., 0.5, 0.1]),
        ("rot_2", [0.2, 0.5, 0.3]),
        ("rot_3", [0.4, -0.5, 0.]),
    ]
}

/// Writes a binary PLY of `columns`, whose values are float unless `types` says otherwise.
pub fn write_ply(path: &Path, columns: &[(&str, [f64; 3])], types: &[(&str, &str)]) {
    let type_of = |name: &str| types.iter().find(|(own, _)| *own == name).map_or("float", |(_, of)| of);
    let mut bytes = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n".to_vec();
    for (name, _) in columns {
        bytes.extend(format!("property {} {name}\n", type_of(name)).bytes());
    }
    bytes.extend(b"end_header\n");
    for row in 0..3 {
        for (name, values) in columns {
            match type_of(name) {
                "uchar" => bytes.push(values[row] as u8),
                "ushort" => bytes.extend((values[row] as u16).to_le_bytes()),
                "double" => bytes.extend(values[row].to_le_bytes()),
                _ => bytes.extend((values[row] as f32).to_le_bytes()),
            }
        }
    }
    std::fs::write(path, bytes).unwrap();
}

/// Cases of three Gaussians, each with an invalid value: the file, the field that its error names, and the property that a warning names.
pub fn files_with_invalid_values(folder: &Path) -> Vec<(PathBuf, &'static str, &'static str)> {
    let mut cases: Vec<(PathBuf, &str, &str)> = [
        ("x", f64::NAN),
        ("z", f64::INFINITY),
        ("y", 1e39),
        ("f_dc_1", f64::NEG_INFINITY),
        ("f_rest_7", f64::NAN),
        ("opacity", f64::NAN),
        ("scale_2", f64::NAN),
        ("scale_0", f64::INFINITY),
        ("scale_1", 89.),
        ("rot_0", f64::NAN),
        ("rot_3", f64::INFINITY),
    ]
    .into_iter()
    .map(|(name, value)| {
        let path = write_changed_ply(folder, &format!("{name}.ply"), |columns| set(columns, name, 1, value));
        (path, name, name)
    })
    .collect();
    // .splat files have no property names.
    let dot_splat = |name: &str, at: usize, value: f32| {
        let path = written(folder, name, &random_splat(3, 0, 1));
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[32 + at..][..4].copy_from_slice(&value.to_le_bytes());
        std::fs::write(&path, bytes).unwrap();
        path
    };
    cases.push((dot_splat("position.splat", 4, f32::NAN), "the position", "position"));
    cases.push((dot_splat("infinite.splat", 12, f32::INFINITY), "the scale", "scale"));
    cases.push((dot_splat("negative.splat", 20, -0.1), "the scale", "scale"));
    cases
}

/// Writes files as of other programs in which the second of three Gaussians has a rotation of length 0: values that underflow, in a PLY;
/// the middle of the byte range, in a .splat.
pub fn files_without_a_rotation(folder: &Path) -> [PathBuf; 2] {
    let ply = folder.join("zero.ply");
    let mut columns = small_gaussians();
    columns.iter_mut().filter(|(name, _)| name.starts_with("rot")).for_each(|(_, values)| values[1] = 1e-40);
    write_ply(&ply, &columns, &[]);
    let dot_splat = written(folder, "zero.splat", &random_splat(3, 0, 1));
    let mut bytes = std::fs::read(&dot_splat).unwrap();
    bytes[32 + 28..64].fill(128);
    std::fs::write(&dot_splat, bytes).unwrap();
    [ply, dot_splat]
}

/// Writes a PLY of [`small_gaussians`] with spherical harmonics of degree 1, after `change`.
pub fn write_changed_ply(folder: &Path, name: &str, change: impl FnOnce(&mut Columns)) -> PathBuf {
    const REST: [&str; 9] = [
        "f_rest_0", "f_rest_1", "f_rest_2", "f_rest_3", "f_rest_4", "f_rest_5", "f_rest_6", "f_rest_7",
        "f_rest_8",
    ];
    let path = folder.join(name);
    let mut columns = small_gaussians();
    columns.extend(REST.map(|name| (name, [if name == "f_rest_0" { 0.1 } else { 0. }; 3])));
    change(&mut columns);
    write_ply(&path, &columns, &[]);
    path
}

/// Sets a value of the property `name`.
pub fn set(columns: &mut Columns, name: &str, row: usize, value: f64) {
    columns.iter_mut().find(|(own, _)| *own == name).unwrap().1[row] = value;
}

/// Writes `surfels.ply`, a 2DGS splat of [`small_gaussians`], which has no third scale, and returns its path.
pub fn write_surfels(folder: &Path) -> PathBuf {
    let mut columns = small_gaussians();
    columns.retain(|(name, _)| *name != "scale_2");
    let path = folder.join("surfels.ply");
    write_ply(&path, &columns, &[]);
    path
}
