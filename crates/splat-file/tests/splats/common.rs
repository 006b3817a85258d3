//! Test utilities: splats, files that other programs would write, and checks of error messages.
#![allow(dead_code)] // the program's tests use only a part

use glam::{DVec4, Vec3};
use globalsplat_splat_file::{Error, SH_C0, Splat, read_splat, write_splat};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use std::path::{Path, PathBuf};

/// Extensions of all formats that are written.
pub const ENDINGS: [&str; 7] = ["ply", "compressed.ply", "sog", "spz", "splat", "glb", "gltf"];

/// Returns random numbers in [-1, 1).
pub fn symmetric<const N: usize>(random: &mut StdRng) -> [f32; N] {
    std::array::from_fn(|_| random.random_range(-1. ..1.))
}

/// Returns a splat whose values are within the range of every format: coefficients within ±0.9, displayable colors.
pub fn random_splat(count: usize, degree: usize, seed: u64) -> Splat {
    let random = &mut StdRng::seed_from_u64(seed);
    let (mut means, mut log_scales, mut quaternions) = (vec![], vec![], vec![]);
    let (mut opacity_logits, mut sh) = (vec![], vec![]);
    for _ in 0..count {
        let [x, y, z] = symmetric(random).map(|number| 3. * number);
        means.push([x, y, z + 6.]);
        log_scales.push(symmetric(random).map(|number| number - 2.));
        quaternions.push(symmetric(random));
        let opacity: f32 = random.random();
        opacity_logits.push((opacity / (1. - opacity)).ln());
        sh.extend((0..(degree + 1).pow(2)).map(|_| symmetric(random).map(|number| 0.9 * number)));
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

/// Returns the difference between rotations, from quaternions of any length; q and −q are the same rotation.
fn rotation_error(a: &Splat, b: &Splat) -> f64 {
    let unit = |quaternion: &[f32; 4]| DVec4::from(quaternion.map(f64::from)).normalize();
    let errors = a.quaternions.iter().zip(&b.quaternions).map(|(a, b)| {
        let (a, b) = (unit(a), unit(b));
        (a - a.dot(b).signum() * b).abs().max_element()
    });
    errors.fold(0., f64::max)
}

/// Reorders the Gaussians of `to` to match `from`, each to its nearest.
pub fn matched(from: &Splat, to: &Splat) -> Splat {
    let nearest_to = |&mean: &[f32; 3]| {
        let distance = |index: usize| Vec3::from(mean).distance_squared(to.means[index].into());
        (0..to.len()).min_by(|&a, &b| distance(a).total_cmp(&distance(b))).expect("a Gaussian")
    };
    let nearest: Vec<usize> = from.means.iter().map(nearest_to).collect();
    let distinct: std::collections::HashSet<_> = nearest.iter().collect();
    assert_eq!(distinct.len(), nearest.len(), "each to another");
    to.select(&nearest)
}

/// Returns the coefficients of the bases from `from` up to `to`.
pub fn bases(splat: &Splat, from: usize, to: usize) -> Vec<f32> {
    let range = from.min(splat.bases())..to.min(splat.bases());
    (0..splat.len()).flat_map(|index| splat.sh_of(index)[range.clone()].as_flattened()).copied().collect()
}

/// Checks that the quantization errors are at most those of [`max_errors`].
pub fn assert_within(what: &str, original: &Splat, copy: &Splat, max_errors: [f64; 7]) {
    let (a, b) = (original, &matched(original, copy));
    let opacities = |splat: &Splat| (0..splat.len()).map(|index| splat.opacity(index)).collect::<Vec<_>>();
    let errors = [
        ("means", largest_error(a.means.as_flattened(), b.means.as_flattened())),
        ("log scales", largest_error(a.log_scales.as_flattened(), b.log_scales.as_flattened())),
        ("quaternions", rotation_error(a, b)),
        ("opacities", largest_error(&opacities(a), &opacities(b))),
        ("degree 0", largest_error(&bases(a, 0, 1), &bases(b, 0, 1))),
        ("degree 1", largest_error(&bases(a, 1, 4), &bases(b, 1, 4))),
        ("degrees 2 and 3", largest_error(&bases(a, 4, 16), &bases(b, 4, 16))),
    ];
    for ((name, error), max) in errors.into_iter().zip(max_errors) {
        assert!(error <= max, "{what}: {name} are off by {error}, {max} at most");
    }
}

/// Returns the maximum quantization errors of a format, half a step with a margin for float32: of positions, logarithms of scales,
/// quaternions, opacities, SH of degree 0, of degree 1 and of higher degrees.
pub fn max_errors(ending: &str) -> [f64; 7] {
    match ending {
        "ply" => [0.; 7],
        // Steps are fractions of the Gaussians' bounds, which are 6 wide in positions, 2 in logarithms, 1.8·C0 and more in colors.
        "compressed.ply" => {
            [3.1 / 1023., 1.01 / 1023., 0.0028, 0.51 / 255., 0.91 / 255., 0.5 / 32. + 1e-6, 0.5 / 32. + 1e-6]
        }
        // Positions are at most 9, in 65,535 steps of 4.5 in their logarithms; rotations have eight bits of ±1/√2; the codebooks
        // have 256 values for 6 in the most dense part, and about as many for all colors and coefficients.
        "sog" => [4.5 * 10. / 65_535., 0.02, 0.006, 0.51 / 255., 0.02, 0.02, 0.02],
        // The largest position, 9, is below 2^23 / 2^19; rotations have nine bits of 1/√2.
        "spz" => [
            0.5 / f64::from(1 << 19) + 1e-6,
            0.5 / 16. + 1e-6,
            0.0028,
            0.51 / 255.,
            0.51 / 255. / 0.15,
            0.5 / 128. + 1e-6,
            0.5 / 64. + 1e-6,
        ],
        // Scales and opacities are linear, colors unlimited, all in float32.
        "glb" | "gltf" => [0., 1e-6, 1e-6, 1e-7, 0., 0., 0.],
        _ => [0., 1e-6, 0.012, 0.51 / 255., 0.51 / 255. / SH_C0, 0., 0.],
    }
}

/// Checks that `error` contains all of `parts`.
#[track_caller]
pub fn assert_says(error: &str, parts: &[&str]) {
    for part in parts {
        assert!(error.contains(part), "{part:?} is not in: {error}");
    }
}

/// Writes `splat` to a file of the format `ending` and reads it again.
pub fn round_trip(ending: &str, splat: &Splat) -> Splat {
    let folder = tempfile::tempdir().unwrap();
    read_splat(&written(folder.path(), &format!("a.{ending}"), splat)).unwrap()
}

/// Returns the bytes of a file of the format `ending`.
pub fn bytes_of(ending: &str, splat: &Splat) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    std::fs::read(written(folder.path(), &format!("a.{ending}"), splat)).unwrap()
}

/// Reads a file of the format `ending` with these bytes.
pub fn read_bytes(ending: &str, bytes: &[u8]) -> Result<Splat, Error> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(format!("a.{ending}"));
    std::fs::write(&path, bytes).unwrap();
    read_splat(&path)
}

/// Returns the one-sentence message of an error, which is a wrong request.
pub fn refusal(read: Result<Splat, Error>) -> String {
    let error = read.expect_err("an invalid file");
    assert!(error.is_invalid_request(), "{error}");
    let text = error.to_string();
    assert_eq!(text.lines().count(), 1, "one sentence: {text}");
    text
}

/// Checks that the file at `path` is refused with a message that contains all of `parts`.
#[track_caller]
pub fn assert_refused(path: &Path, parts: &[&str]) {
    assert_says(&refusal(read_splat(path)), parts);
}

/// Checks that a file of the format `ending` with these bytes is refused with a message that contains all of `parts`.
#[track_caller]
pub fn assert_bytes_refused(ending: &str, bytes: &[u8], parts: &[&str]) {
    let error = refusal(read_bytes(ending, bytes));
    assert_says(&error, &[&format!("a.{ending}: ")]);
    assert_says(&error, parts);
}

/// Checks that a file of the format `ending` is refused after bytes at an offset are replaced, each case with a message of its own.
#[track_caller]
pub fn assert_changes_refused(ending: &str, whole: &[u8], cases: &[(usize, &[u8], &str)]) {
    for (at, replacement, message) in cases {
        let mut bytes = whole.to_vec();
        bytes[*at..][..replacement.len()].copy_from_slice(replacement);
        assert_bytes_refused(ending, &bytes, &[message]);
    }
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

/// Writes a PLY of `columns` as text, whose values are float unless `types` says otherwise.
pub fn write_ply(path: &Path, columns: &[(&str, [f64; 3])], types: &[(&str, &str)]) {
    let mut text = "ply\nformat ascii 1.0\nelement vertex 3\n".to_string();
    for (name, _) in columns {
        let kind = types.iter().find(|(own, _)| own == name).map_or("float", |(_, kind)| kind);
        text += &format!("property {kind} {name}\n");
    }
    text += "end_header\n";
    for row in 0..3 {
        columns.iter().for_each(|(_, values)| text += &format!("{} ", values[row]));
    }
    std::fs::write(path, text).unwrap();
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
    for (name, at, value, property) in [
        ("position.splat", 4, f32::NAN, "position"),
        ("infinite.splat", 12, f32::INFINITY, "scale"),
        ("negative.splat", 20, -0.1, "scale"),
    ] {
        let mut bytes = bytes_of("splat", &random_splat(3, 0, 1));
        bytes[32 + at..][..4].copy_from_slice(&value.to_le_bytes());
        std::fs::write(folder.join(name), bytes).unwrap();
        cases.push((folder.join(name), property, property));
    }
    cases
}

/// Writes files as of other programs in which the second of three Gaussians has a rotation of length 0: values that underflow, in a PLY;
/// the middle of the byte range, in a .splat.
pub fn files_without_a_rotation(folder: &Path) -> [PathBuf; 2] {
    let ply = write_changed_ply(folder, "zero.ply", |columns| {
        (0..4).for_each(|part| set(columns, &format!("rot_{part}"), 1, 1e-40));
    });
    let dot_splat = folder.join("zero.splat");
    let mut bytes = bytes_of("splat", &random_splat(3, 0, 1));
    bytes[32 + 28..64].fill(128);
    std::fs::write(&dot_splat, bytes).unwrap();
    [ply, dot_splat]
}

/// Writes a PLY of [`small_gaussians`] with spherical harmonics of degree 1, after `change`.
pub fn write_changed_ply(folder: &Path, name: &str, change: impl FnOnce(&mut Columns)) -> PathBuf {
    let path = folder.join(name);
    let mut columns = small_gaussians();
    columns.extend((0..9).map(|k| (&*format!("f_rest_{k}").leak(), [if k == 0 { 0.1 } else { 0. }; 3])));
    change(&mut columns);
    write_ply(&path, &columns, &[]);
    path
}

/// Sets a value of the property `name`.
pub fn set(columns: &mut Columns, name: &str, row: usize, value: f64) {
    columns.iter_mut().find(|(own, _)| *own == name).unwrap().1[row] = value;
}
