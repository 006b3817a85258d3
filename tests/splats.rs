//! Splat formats: round trips, the values that each format stores, and invalid files.

mod common;

use common::program::{arg, refuse, room, succeed};
use common::{Random, largest_error};
use globalsplat::io::{Splat, find_splat, fit_splat, read_splat, read_splat_without_invalid, write_splat};
use globalsplat::render::{HarmonicLimits, render_views};
use globalsplat::scene::{Camera, Gaussians, Intrinsics};
use serde_json::Value;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use tch::{Kind, Tensor};

const ENDINGS: [&str; 4] = ["ply", "compressed.ply", "spz", "splat"];

/// Returns a splat whose values are within the range of every format: coefficients within ±0.9, displayable colours.
fn random_splat(count: i64, degree: i64, seed: u64) -> Splat {
    let mut random = Random::new(seed);
    let bases = (degree + 1) * (degree + 1);
    let gaussians = Gaussians {
        means: random.symmetric(&[1, count, 3]) * 3. + Tensor::from_slice(&[0., 0., 6.]),
        scales: (random.symmetric(&[1, count, 3]) - 2.).exp(),
        quaternions: random.symmetric(&[1, count, 4]),
        opacities: random.uniform(&[1, count]),
        sh: random.symmetric(&[1, count, bases, 3]) * 0.9,
    };
    Splat::of(&gaussians).unwrap()
}

fn written(folder: &Path, name: &str, splat: &Splat) -> PathBuf {
    let path = folder.join(name);
    write_splat(&path, splat).unwrap();
    path
}

/// Returns the difference between rotations, from quaternions of any length; q and −q are the same rotation.
fn rotation_error(a: &Tensor, b: &Tensor) -> f64 {
    let unit = |q: &Tensor| q / q.norm_scalaropt_dim(2, [-1i64].as_slice(), true);
    let (a, b) = (unit(a), unit(b));
    let same_side = (&a * &b).sum_dim_intlist([-1i64].as_slice(), true, Kind::Float).sign();
    largest_error(&a, &(b * same_side))
}

/// Reorders the Gaussians of `to` to match `from`, each to its nearest.
fn matched(from: &Gaussians, to: &Gaussians) -> Gaussians {
    let distances = (from.means.squeeze_dim(0).unsqueeze(1) - to.means.squeeze_dim(0).unsqueeze(0))
        .square()
        .sum_dim_intlist([-1i64].as_slice(), false, Kind::Float);
    let nearest = distances.argmin(1, false);
    assert_eq!(nearest.unique_dim(0, true, false, false).0.size(), nearest.size(), "each to another");
    to.map(|tensor| tensor.index_select(1, &nearest))
}

/// Maximum quantization errors: of positions, logarithms of scales, quaternions, opacities, SH of degree 0, of degree 1 and of
/// higher degrees.
struct Steps([f64; 7]);

fn assert_within(what: &str, original: &Splat, copy: &Splat, steps: &Steps) {
    let (a, b) = (&original.gaussians, &matched(&original.gaussians, &copy.gaussians));
    let degree = |g: &Gaussians, from: i64, to: i64| {
        let bases = g.sh.size()[2];
        g.sh.slice(2, from.min(bases), to.min(bases), 1)
    };
    let errors = [
        ("means", largest_error(&a.means, &b.means)),
        ("log scales", largest_error(&a.scales.log(), &b.scales.log())),
        ("quaternions", rotation_error(&a.quaternions, &b.quaternions)),
        ("opacities", largest_error(&a.opacities, &b.opacities)),
        ("degree 0", largest_error(&degree(a, 0, 1), &degree(b, 0, 1))),
    ];
    let higher =
        [("degree 1", 1, 4), ("degrees 2 and 3", 4, 16)].into_iter().filter_map(|(name, from, to)| {
            let (a, b) = (degree(a, from, to), degree(b, from, to));
            (a.numel() > 0).then(|| (name, largest_error(&a, &b)))
        });
    for ((name, error), step) in errors.into_iter().chain(higher).zip(steps.0) {
        assert!(error <= step, "{what}: {name} are off by {error}, {step} at most");
    }
}

/// Returns the quantization errors of each format, at most half a step, with a margin for float32.
fn steps(ending: &str, count: i64) -> Steps {
    const C0: f64 = 0.2820947918;
    match ending {
        "ply" => Steps([0., 1e-6, 1e-6, 2e-6, 0., 0., 0.]),
        // Steps are fractions of the Gaussians' bounds, which are 6 wide in positions, 2 in logarithms, 1.8·C0 and more in
        // colours.
        "compressed.ply" => {
            assert!(count > 0);
            Steps([
                3.1 / 1023.,
                1.01 / 1023.,
                0.0028,
                0.51 / 255.,
                0.91 / 255.,
                0.5 / 32. + 1e-6,
                0.5 / 32. + 1e-6,
            ])
        }
        // The largest position, 9, is below 2^23 / 2^19; rotations have nine bits of 1/√2.
        "spz" => Steps([
            0.5 / f64::from(1 << 19) + 1e-6,
            0.5 / 16. + 1e-6,
            0.0028,
            0.51 / 255.,
            0.51 / 255. / 0.15,
            0.5 / 128. + 1e-6,
            0.5 / 64. + 1e-6,
        ]),
        _ => Steps([0., 1e-6, 0.012, 0.51 / 255., 0.51 / 255. / C0, 0., 0.]),
    }
}

#[test]
fn what_is_written_comes_back_to_half_a_step() {
    let folder = tempfile::tempdir().unwrap();
    for (seed, degree) in (0..4).enumerate() {
        for count in [1, 256, 257, 600] {
            let splat = random_splat(count, degree, seed as u64);
            for ending in ENDINGS {
                let path = written(folder.path(), &format!("splat.{ending}"), &splat);
                let copy = read_splat(&path).unwrap();
                let expected = if ending == "splat" { 0 } else { degree };
                assert_eq!((copy.gaussians.count(), copy.sh_degree()), (count, expected), "{ending}");
                let what = format!("{ending} of {count} Gaussians of degree {degree}");
                assert_within(&what, &splat.with_sh_degree(expected), &copy, &steps(ending, count));
            }
        }
    }
}

/// Returns a camera at the origin that looks along z, 64×64.
fn camera() -> Camera {
    let intrinsics = Intrinsics { fx: 60., fy: 60., cx: 32., cy: 32. };
    Camera { intrinsics, c2w: glam::DMat4::IDENTITY, width: 64, height: 64 }
}

fn psnr_of_pictures(a: &Splat, b: &Splat, camera: Camera) -> f64 {
    let seen = |splat: &Splat| render_views(&splat.gaussians, &[camera]).unwrap().remove(0).rgb;
    globalsplat::eval::psnr(&seen(a), &seen(b))
}

/// Renders from all sides are the same after a round trip: a wrong sign, order or axis would show from some side.
#[test]
fn pictures_are_the_same_from_other_sides() {
    let folder = tempfile::tempdir().unwrap();
    let mut splat = random_splat(400, 3, 7);
    splat.gaussians.sh *= 0.5;
    for ending in ENDINGS {
        let degree = if ending == "splat" { 0 } else { 3 };
        let original = splat.with_sh_degree(degree);
        let copy = read_splat(&written(folder.path(), &format!("a.{ending}"), &original)).unwrap();
        for side in 0..6 {
            let turn = glam::DMat4::from_rotation_y(f64::from(side)) * glam::DMat4::from_rotation_x(0.4);
            let centre = glam::DMat4::from_translation([0., 0., 6.].into());
            let c2w = centre * turn * glam::DMat4::from_translation([0., 0., -8.].into());
            let psnr = psnr_of_pictures(&original, &copy, Camera { c2w, ..camera() });
            assert!(psnr > 27., "{ending} from side {side}: {psnr} dB");
        }
    }
}

/// An SPZ file has the values of the first Gaussian at the offsets of SPZ's documentation.
#[test]
fn an_spz_is_as_documented() {
    let folder = tempfile::tempdir().unwrap();
    let mut splat = random_splat(1, 1, 1);
    splat.gaussians = Gaussians {
        means: Tensor::from_slice(&[1f32, 2., 3.]).view([1, 1, 3]),
        scales: Tensor::from_slice(&[-1f32, -2., -3.]).exp().view([1, 1, 3]),
        quaternions: Tensor::from_slice(&[0.9f32, 0.1, 0.2, 0.3]).view([1, 1, 4]),
        opacities: Tensor::from_slice(&[0.5f32]).sigmoid().view([1, 1]),
        sh: Tensor::from_slice(&[0.1f32, 0.2, 0.3, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
            .view([1, 1, 4, 3]),
    };
    let bytes = std::fs::read(written(folder.path(), "one.spz", &splat)).unwrap();
    let mut unfolded = vec![];
    flate2::bufread::GzDecoder::new(&bytes[..]).read_to_end(&mut unfolded).unwrap();
    assert_eq!(unfolded[..4], *b"NGSP");
    assert_eq!(unfolded[4..16], [3, 0, 0, 0, 1, 0, 0, 0, 1, 21, 0, 0], "version, Gaussians, degree, bits");
    // Niantic's library gives these bytes for these values, except for positions, which it stores with 12 fractional bits, and
    // coefficients.
    assert_eq!(unfolded[25..36], hex("9f83878b908070de52aac4")[..]);
    // Bytes of the coefficients: −0.1·128 + 128 and so on; y and z change their sign.
    assert_eq!(unfolded[36..], hex("73665a4d4033dae6f3"));
    let fixed = |at: usize| i32::from_le_bytes([0, unfolded[at], unfolded[at + 1], unfolded[at + 2]]) >> 8;
    assert_eq!([16, 19, 22].map(fixed), [1 << 21, -(2 << 21), -(3 << 21)]);
}

fn hex(text: &str) -> Vec<u8> {
    let digits = text.as_bytes().chunks_exact(2);
    digits.map(|two| u8::from_str_radix(std::str::from_utf8(two).unwrap(), 16).unwrap()).collect()
}

/// Each of the four versions of SPZ gives the same Gaussian, from bytes written by the format's documentation.
#[test]
fn older_versions_of_spz_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let head = |version: u8| [b"NGSP", &[version, 0, 0, 0, 1, 0, 0, 0, 1, 12, 0, 0][..]].concat();
    let shape = hex("9f83878b908070");
    let harmonics = hex("706858504030d8e8f0");
    // Positions 1, 2 and 3 as half-precision floats, and with 12 fractional bits; x, y and z of the rotation in a byte each.
    let halves = [0x3c00u16, 0xc000, 0xc200].map(u16::to_le_bytes).concat();
    let one = [head(1), halves, shape.clone(), hex("8d6558"), harmonics.clone()].concat();
    let two = [head(2), hex("00100000e0ff00d0ff"), shape.clone(), hex("8d6558"), harmonics.clone()].concat();
    let three = [head(3), hex("00100000e0ff00d0ff"), shape, hex("de52aac4"), harmonics].concat();
    // File written by Niantic's library.
    let four = hex(
        "4e4753500400000001000000010c000620000000000000000000000000000000120000000000000009000000000000000a0000000000000\
         001000000000000000c0000000000000003000000000000000c0000000000000003000000000000000d000000000000000400000000000\
         00012000000000000000900000000000000\
         28b52ffd200949000000100000e0ff00d0ff28b52ffd20010900009f28b52ffd200319000083878b28b52ffd200319000090807028b52ff\
         d2004210000de52aac428b52ffd2009490000706858504030d8e8f0",
    );
    for (version, bytes) in [(1, gzip(&one)), (2, gzip(&two)), (3, gzip(&three)), (4, four)] {
        let path = folder.path().join(format!("{version}.spz"));
        std::fs::write(&path, bytes).unwrap();
        let g = read_splat(&path).unwrap_or_else(|e| panic!("{e}")).gaussians;
        let near = |tensor: &Tensor, numbers: &[f32], step: f64| {
            let expected = Tensor::from_slice(numbers).view(tensor.size().as_slice());
            assert!(largest_error(tensor, &expected) <= step, "version {version}: {tensor}, not {numbers:?}");
        };
        near(&g.means, &[1., 2., 3.], 0.);
        near(&g.scales.log(), &[-1., -2., -3.], 1. / 32. + 1e-6);
        let length = 0.95f32.sqrt();
        near(&g.quaternions, &[0.9 / length, 0.1 / length, 0.2 / length, 0.3 / length], 0.006);
        near(&g.opacities, &[0.622_459], 0.51 / 255.);
        near(&g.sh, &[0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9], 1. / 32. + 1e-6);
    }
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(vec![], flate2::Compression::default());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// The axes that an extension of an SPZ names are applied: here those of PLYs, for which no sign changes.
#[test]
fn the_axes_of_an_spz_are_heeded() {
    let folder = tempfile::tempdir().unwrap();
    let with_axes = |number: u32| {
        let head = [b"NGSP", &[3, 0, 0, 0, 1, 0, 0, 0, 1, 12, 2, 0][..]].concat();
        let extension = [0xADBE_0003u32, 4, number].map(u32::to_le_bytes).concat();
        let unknown = [0x1234_0001u32, 4, 0].map(u32::to_le_bytes).concat();
        let streams = hex("00100000e0ff00d0ff9f83878b908070de52aac4706858504030d8e8f0");
        let path = folder.path().join(format!("{number}.spz"));
        std::fs::write(&path, gzip(&[head, streams, unknown, extension].concat())).unwrap();
        path
    };
    let [rub, rdf] = [4, 6].map(|number| read_splat(&with_axes(number)).unwrap().gaussians);
    let turned = Tensor::from_slice(&[1f32, -1., -1.]);
    assert!((&rub.means * &turned).equal(&rdf.means));
    // The order of degree 1 is y, z, x.
    let signs = Tensor::from_slice(&[1f32, -1., -1., 1.]).view([1, 1, 4, 1]);
    assert!((&rub.sh * signs).equal(&rdf.sh));
    assert!((&rub.quaternions * Tensor::from_slice(&[1f32, 1., -1., -1.])).equal(&rdf.quaternions));
    assert_says(&refuse(&["inspect", arg(&with_axes(9))]), &["the coordinate system is 9", "1 to 8"]);
}

/// A PLY is read identically as text, in both byte orders, and with all other elements that it may contain.
#[test]
fn a_ply_is_read_however_it_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let splat = random_splat(3, 1, 5);
    let plain = std::fs::read(written(folder.path(), "plain.ply", &splat)).unwrap();
    let end = plain.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let names: Vec<String> = String::from_utf8_lossy(&plain[..end])
        .lines()
        .filter_map(|line| Some(line.strip_prefix("property float ")?.to_string()))
        .collect();
    let numbers: Vec<f32> = plain[end..].as_chunks().0.iter().map(|&four| f32::from_le_bytes(four)).collect();
    let order: Vec<usize> = (0..names.len()).rev().collect();
    for encoding in ["ascii", "binary_little_endian", "binary_big_endian"] {
        let (text, big) = (encoding == "ascii", encoding == "binary_big_endian");
        let mut header =
            format!("ply\r\nformat {encoding} 1.0\r\ncomment end_header of element vertex 7\r\n");
        header += "element camera 2\r\nproperty list uchar short matrix\r\nproperty double focal\r\n";
        header += "element vertex 3\r\n";
        for &column in &order {
            header +=
                &format!("property double {}\r\nproperty list int uchar more_{column}\r\n", names[column]);
        }
        header += "element face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n";
        let mut bytes = header.into_bytes();
        let mut put = |number: f64, size: usize, integer: bool| {
            if text {
                bytes.extend(format!("{number}\n ").bytes());
                return;
            }
            let mut one = if integer { (number as i64).to_le_bytes() } else { number.to_le_bytes() };
            if big {
                one[..size].reverse();
            }
            bytes.extend(&one[..size]);
        };
        for length in [3, 0] {
            put(f64::from(length), 1, true);
            (0..length).for_each(|k| put(f64::from(k - 1), 2, true));
            put(1.5, 8, false);
        }
        for row in 0..3 {
            for &column in &order {
                put(f64::from(numbers[row * names.len() + column]), 8, false);
                put(2., 4, true);
                put(200., 1, true);
                put(7., 1, true);
            }
        }
        put(1., 1, true);
        put(-2., 4, true);
        let path = folder.path().join("other.ply");
        std::fs::write(&path, &bytes).unwrap();
        let (a, b) =
            (read_splat(&folder.path().join("plain.ply")).unwrap().gaussians, read_splat(&path).unwrap());
        for (a, b) in
            [(&a.means, &b.gaussians.means), (&a.sh, &b.gaussians.sh), (&a.scales, &b.gaussians.scales)]
        {
            assert!(a.equal(b), "{encoding}");
        }
        assert!(a.quaternions.equal(&b.gaussians.quaternions) && a.opacities.equal(&b.gaussians.opacities));
    }
}

/// Opacities of exactly 1 and 0 have infinite logits, and scales of 0 an infinite logarithm, in files of programs that store
/// bytes.
#[test]
fn infinite_logits_are_opacities_of_0_and_1() {
    let folder = tempfile::tempdir().unwrap();
    let path = written(folder.path(), "a.ply", &random_splat(1, 0, 3));
    let mut bytes = std::fs::read(&path).unwrap();
    let body = bytes.len() - 17 * 4;
    let set = |bytes: &mut Vec<u8>, column: usize, number: f32| {
        bytes[body + 4 * column..][..4].copy_from_slice(&number.to_le_bytes());
    };
    set(&mut bytes, 9, f32::INFINITY);
    set(&mut bytes, 10, f32::NEG_INFINITY);
    std::fs::write(&path, &bytes).unwrap();
    let g = read_splat(&path).unwrap().gaussians;
    assert_eq!((g.opacities.double_value(&[0, 0]), g.scales.double_value(&[0, 0, 0])), (1., 0.));
    set(&mut bytes, 10, 89.);
    std::fs::write(&path, &bytes).unwrap();
    assert_says(&refuse(&["inspect", arg(&path)]), &["scale_0 of vertex 0 is 89", "at most 88"]);
}

fn assert_says(error: &str, parts: &[&str]) {
    for part in parts {
        assert!(error.contains(part), "{part:?} is not in: {error}");
    }
}

#[test]
fn endings_that_are_unknown() {
    let folder = tempfile::tempdir().unwrap();
    let splat = written(folder.path(), "a.ply", &random_splat(2, 0, 1));
    for (name, told) in [("a.obj", "the ending is .obj"), ("a", "the ending is absent")] {
        let to = folder.path().join(name);
        let all = [told, "expected .ply, .compressed.ply, .spz or .splat"];
        assert_says(&refuse(&["convert", arg(&splat), arg(&to)]), &all);
        std::fs::copy(&splat, &to).unwrap();
        assert_says(&refuse(&["convert", arg(&to), arg(&splat)]), &all);
        std::fs::remove_file(&to).unwrap();
    }
    let (_kept, room) = room();
    let out = folder.path().join("made.sog");
    let refine = ["refine", "--scene", arg(&room), "--steps", "1", "--out", arg(&out)];
    assert_says(&refuse(&refine), &["the ending is .sog"]);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing was written");
}

/// The contents of a file determine its format, not its name, for formats that can be recognized.
#[test]
fn files_are_recognized() {
    let folder = tempfile::tempdir().unwrap();
    let splat = random_splat(300, 2, 2);
    for ending in &ENDINGS[..3] {
        let path = written(folder.path(), &format!("a.{ending}"), &splat);
        for other in ENDINGS {
            let renamed = folder.path().join(format!("renamed.{other}"));
            std::fs::copy(&path, &renamed).unwrap();
            assert_eq!(read_splat(&renamed).unwrap().gaussians.count(), 300, "{ending} as {other}");
        }
    }
    assert_eq!(find_splat(folder.path(), "a"), folder.path().join("a.compressed.ply"));
    assert_eq!(find_splat(folder.path(), "b"), folder.path().join("b.ply"));
}

/// Returns the error message for a file of `ending` whose bytes are changed.
fn refused(ending: &str, change: impl FnOnce(&mut Vec<u8>)) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = written(folder.path(), &format!("broken.{ending}"), &random_splat(300, 1, 9));
    let mut bytes = std::fs::read(&path).unwrap();
    change(&mut bytes);
    std::fs::write(&path, bytes).unwrap();
    let error = refuse(&["inspect", arg(&path)]);
    assert_says(&error, &[&format!("broken.{ending}: ")]);
    error
}

fn in_header(bytes: &mut Vec<u8>, from: &str, to: &str) {
    let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
    bytes.splice(at..at + from.len(), to.bytes());
}

#[test]
fn bad_plys() {
    let header = |from: &'static str, to: &'static str| refused("ply", |bytes| in_header(bytes, from, to));
    assert_says(&header("little", "middle"), &["the format is binary_middle_endian", "ascii"]);
    assert_says(&header("format", "comment"), &["the line format is absent"]);
    assert_says(
        &header("vertex 300", "vertex many"),
        &["rows of the element vertex is many", "a whole number"],
    );
    assert_says(&header("element vertex 300\n", ""), &["the property x is without an element"]);
    assert_says(&header("element vertex", "element point"), &["the element vertex is absent"]);
    assert_says(&header("float opacity", "half opacity"), &["the type of opacity is half"]);
    assert_says(&header("float opacity", "float half opacity"), &["the type of opacity is \"float half\""]);
    assert_says(&header("float opacity", "list float opacity"), &["the type of opacity"]);
    assert_says(&header("float opacity", "list uchar float opacity"), &["property opacity is a list"]);
    assert_says(&header("f_rest_8", "f_rest_9"), &["f_rest_* is 8 properties", "0, 9, 24 or 45"]);
    assert_says(&header("vertex 300", "vertex 1000000000"), &["the body is cut short", "104000000000 bytes"]);
    assert_says(&header("vertex 300", "vertex 18446744073709551615"), &["the body is cut short"]);
    assert_says(&header("binary_little_endian", "ascii"), &["in row 0 of vertex is", "expected a number"]);
    let list = |kind: &str| {
        let line = format!("element face 1000000000000\nproperty list {kind} int i\nelement vertex");
        refused("ply", |bytes| in_header(bytes, "element vertex", &line))
    };
    assert_says(&list("uchar"), &["the body is cut short"]);
    let lengths = |length: f64| {
        let line = "element face 1\nproperty list double int i\nelement vertex";
        refused("ply", |bytes| {
            in_header(bytes, "element vertex", line);
            let body = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
            bytes.splice(body..body, length.to_le_bytes());
        })
    };
    assert_says(&lengths(-1.), &["the length of the list i in row 0 of face is -1", "a whole number"]);
    assert_says(&lengths(f64::NAN), &["the length of the list i", "NaN"]);
    assert_says(&lengths(1e300), &["the body is cut short"]);
}

#[test]
fn bad_compressed_plys() {
    let header =
        |from: &'static str, to: &'static str| refused("compressed.ply", |bytes| in_header(bytes, from, to));
    assert_says(&header("element chunk", "element chunks"), &["the element chunk is absent"]);
    assert_says(
        &header("element chunk 2", "element chunk 1"),
        &["the number of chunks is 1, expected 2 for 300"],
    );
    assert_says(&header("vertex 300", "vertex 4000000000"), &["the body is cut short"]);
    assert_says(&header("float max_b", "float most_b"), &["property max_b is absent"]);
    assert_says(
        &header("uint packed_scale", "int packed_scale"),
        &["the type of packed_scale is another", "uint"],
    );
    assert_says(&header("uchar f_rest_3", "char f_rest_3"), &["the type of f_rest_3 is another", "uchar"]);
    assert_says(
        &header("element sh 300", "element sh 299"),
        &["rows of the element sh is 299, expected 300"],
    );
    assert_says(&header("uchar f_rest_8", "uchar f_rest_x"), &["f_rest_* is 8 properties"]);
    assert_says(
        &refused("compressed.ply", |bytes| bytes.truncate(bytes.len() - 1)),
        &["the body is cut short"],
    );
    let bound = refused("compressed.ply", |bytes| {
        let body = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        bytes[body..body + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    });
    assert_says(&bound, &["min_x of chunk 0 is NaN", "a finite number"]);
}

/// Bytes are the colours themselves in older files, without bounds of colours.
#[test]
fn older_compressed_plys_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = written(folder.path(), "a.compressed.ply", &random_splat(2, 0, 4));
    let bytes = std::fs::read(&path).unwrap();
    let body = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(bytes[..body].to_vec()).unwrap();
    let colours = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"];
    let header =
        colours.iter().fold(header, |header, name| header.replace(&format!("property float {name}\n"), ""));
    let vertices = &bytes[body + 18 * 4..];
    std::fs::write(&path, [header.as_bytes(), &bytes[body..][..12 * 4], vertices].concat()).unwrap();
    let read = read_splat(&path).unwrap().gaussians.sh;
    let red = f64::from(vertices[15]) / 255.; // the highest byte of the fourth word
    assert!(((red - 0.5) / 0.28209479177387814 - read.double_value(&[0, 0, 0, 0])).abs() < 1e-6);
}

#[test]
fn bad_spzs() {
    let unfolded = |change: &dyn Fn(&mut Vec<u8>)| {
        refused("spz", |bytes| {
            let mut inside = vec![];
            flate2::bufread::GzDecoder::new(&bytes[..]).read_to_end(&mut inside).unwrap();
            change(&mut inside);
            *bytes = gzip(&inside);
        })
    };
    assert_says(&unfolded(&|inside| inside[0] = b'n'), &["the first bytes is", "NGSP"]);
    assert_says(&unfolded(&|inside| inside[4] = 5), &["the version is 5, expected 1 to 4"]);
    assert_says(&unfolded(&|inside| inside[4] = 4), &["the version in gzip is 4, expected 1 to 3"]);
    assert_says(&unfolded(&|inside| inside[12] = 4), &["the SH degree is 4, expected 0 to 3"]);
    assert_says(&unfolded(&|inside| inside[13] = 31), &["fractional bits is 31, expected 0 to 30"]);
    assert_says(&unfolded(&|inside| inside[8] += 1), &["the body is cut short", "for 301 Gaussians"]);
    assert_says(&unfolded(&|inside| inside.truncate(9)), &["the header is 9 bytes"]);
    let claim = unfolded(&|inside| inside[8..12].copy_from_slice(&1_000_000_000u32.to_le_bytes()));
    assert_says(&claim, &["the number of Gaussians is 1000000000, 29000000000 bytes", "256 times"]);
    let bomb = unfolded(&|inside| {
        inside[8..12].copy_from_slice(&200_000u32.to_le_bytes());
        inside.resize(6_000_000, 0);
    });
    assert_says(&bomb, &["the number of Gaussians is 200000", "256 times the file's bytes"]);
    let extension = unfolded(&|inside| {
        inside[14] = 2;
        inside.extend([3, 0, 0xbe, 0xad, 9, 0, 0, 0, 6]);
    });
    assert_says(&extension, &["an extension is cut short: 1 bytes, expected 9 bytes"]);
    assert_says(&refused("spz", |bytes| bytes.truncate(100)), &["damaged", "a whole gzip"]);
    assert_says(&refused("spz", |bytes| *bytes.last_mut().unwrap() ^= 1), &["the end is damaged"]);
    assert_says(&refused("spz", |bytes| *bytes = b"no gzip".to_vec()), &["the file is no SPZ"]);
}

/// A table of contents that doesn't match the data is refused.
#[test]
fn bad_spzs_of_version_4() {
    let plain = |change: &dyn Fn(&mut Vec<u8>)| {
        refused("spz", |bytes| {
            let head = [b"NGSP", &[4, 0, 0, 0, 1, 0, 0, 0, 0, 12, 0, 5, 32, 0, 0, 0][..], &[0; 12]].concat();
            let streams = [9, 1, 3, 3, 4].map(|length| zstd::encode_all(&vec![128; length][..], 1).unwrap());
            let entries = streams.iter().flat_map(|one| [(one.len() as u64).to_le_bytes(), [0; 8]].concat());
            *bytes = [head, entries.collect(), streams.concat()].concat();
            change(bytes);
        })
    };
    assert_says(&plain(&|bytes| bytes[4] = 3), &["the version outside of gzip is 3, expected 4"]);
    assert_says(&plain(&|bytes| bytes.truncate(20)), &["the header is 20 bytes, expected 32"]);
    assert_says(&plain(&|bytes| bytes[15] = 200), &["the table of contents is at 32", "200 entries"]);
    assert_says(&plain(&|bytes| bytes[16..20].fill(255)), &["the table of contents is at 4294967295"]);
    assert_says(&plain(&|bytes| bytes[15] = 4), &["stream"]);
    assert_says(&plain(&|bytes| bytes[32..40].fill(255)), &["stream 0 is cut short"]);
    assert_says(&plain(&|bytes| bytes[8] = 2), &["stream 0 is 9 bytes or more, expected 18 bytes for 2"]);
    assert_says(&plain(&|bytes| bytes[12] = 1), &["stream 5 is absent, expected one of 9 bytes"]);
    assert_says(&plain(&|bytes| bytes[32 + 5 * 16] = 0), &["stream 0 is damaged"]);
    assert_says(&plain(&|bytes| bytes[8..12].fill(255)), &["the number of Gaussians is 4294967295"]);
}

#[test]
fn bad_splats() {
    assert_says(
        &refused("splat", |bytes| bytes.truncate(33)),
        &["the length is 33 bytes", "32 bytes for each"],
    );
    assert_says(&refused("splat", |bytes| bytes.clear()), &["the length is 0 bytes"]);
    let number = |at: usize, value: f32| {
        refused("splat", |bytes| bytes[64 + at..][..4].copy_from_slice(&value.to_le_bytes()))
    };
    assert_says(&number(4, f32::NAN), &["the position of Gaussian 2 is NaN", "finite numbers"]);
    assert_says(&number(20, -1.), &["the scale of Gaussian 2 is -1", "0 or more"]);
}

/// Values that a format can't store are refused, and nothing is written.
#[test]
fn numbers_that_do_not_fit() {
    let folder = tempfile::tempdir().unwrap();
    for ending in ENDINGS {
        let splat = random_splat(3, 1, 1);
        let _ = splat.gaussians.means.narrow(1, 1, 1).fill_(f64::NAN);
        let path = folder.path().join(format!("a.{ending}"));
        assert_says(&write_splat(&path, &splat).unwrap_err().to_string(), &["numbers that aren't finite"]);
    }
    let far = random_splat(3, 1, 1);
    let _ = far.gaussians.means.narrow(1, 1, 1).fill_(1e7);
    let error = write_splat(&folder.path().join("a.spz"), &far).unwrap_err().to_string();
    assert_says(&error, &["a coordinate is 10000000, expected at most 8388607"]);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    // Values that nearly exceed the range are as exact as 24 bits allow.
    let _ = far.gaussians.means.narrow(1, 1, 1).fill_(-8_388_000.);
    let near = read_splat(&written(folder.path(), "a.spz", &far)).unwrap();
    assert!(largest_error(&near.gaussians.means, &far.gaussians.means) <= 0.5);
}

/// `convert` reports both files and the loss, measured on an orbit or from a capture's cameras.
#[test]
fn convert_tells_what_is_lost() {
    let (folder, room) = room();
    let ground_truth = room.join("truth.ply");
    let convert = |to: &str, more: &[&str]| -> Value {
        let to = folder.path().join(to);
        let told = succeed(&[&["convert", arg(&ground_truth), arg(&to), "--json"], more].concat());
        serde_json::from_str(&told).unwrap()
    };
    let same = convert("a.ply", &[]);
    assert_eq!(same["from"]["gaussians"], same["to"]["gaussians"]);
    assert!(same["same_pixels"] == true || same["psnr"].as_f64().unwrap() > 90., "{same}");
    let small = convert("a.spz", &["--scene", arg(&room)]);
    assert_eq!((small["views"].as_u64(), small["same_pixels"].as_bool()), (Some(9), Some(false)));
    assert!(small["psnr"].as_f64().unwrap() > 30., "{small}");
    assert_eq!(small["to"]["bytes"], std::fs::metadata(folder.path().join("a.spz")).unwrap().len());
    assert!(small["to"]["bytes"].as_u64() < small["from"]["bytes"].as_u64());
    for degree in ["0", "3"] {
        let told = convert("b.compressed.ply", &["--sh-degree", degree]);
        assert_eq!(told["to"]["sh_degree"].to_string(), degree);
        assert_eq!(told["views"], 8);
    }
    let told = succeed(&["convert", arg(&ground_truth), arg(&folder.path().join("c.splat"))]);
    assert!(told.contains("Gaussians, SH degree 0, ") && told.contains("dB between renders"), "{told}");
    let out = folder.path().join("d.ply");
    let higher =
        common::program::globalsplat(&["convert", arg(&ground_truth), arg(&out), "--sh-degree", "4"]);
    assert_eq!(higher.status.code(), Some(2));
}

/// Coefficients beyond SPZ's range are clamped without a capture; with a capture the others are fitted to its cameras.
#[test]
fn convert_keeps_what_a_capture_sees() {
    let (folder, room) = room();
    let strong = folder.path().join("strong.ply");
    let splat = read_splat(&room.join("truth.ply")).unwrap().with_sh_degree(3);
    let size = splat.gaussians.sh.size();
    splat.gaussians.sh.narrow(2, 1, 15).copy_(&(Random::new(3).symmetric(&[1, size[1], 15, 3]) * 3.));
    write_splat(&strong, &splat).unwrap();
    let cameras = globalsplat::data::open_capture(&room).unwrap().cameras();
    for (ending, gain, always) in [
        ("spz", 6., &[][..]),
        ("splat", 0.5, &[]),
        ("ply", 6., &["--for-viewers"]),
        ("spz", 6., &["--for-viewers"]),
    ] {
        let psnr = |options: &[&str]| {
            let to = folder.path().join(format!("a.{ending}"));
            succeed(&[&["convert", arg(&strong), arg(&to)], options, always].concat());
            let copy = read_splat(&to).unwrap();
            if !always.is_empty() {
                let colour = copy.gaussians.sh.narrow(2, 0, 1) * 0.28209479177387814;
                let others = copy.gaussians.sh.narrow(2, 1, 15);
                // SPZ's quantization step is 0.03.
                let beyond =
                    [colour.abs().max().double_value(&[]) - 0.5, others.abs().max().double_value(&[]) - 1.];
                assert!(
                    beyond.iter().all(|&beyond| beyond < 0.02),
                    "{ending}: {beyond:?} beyond what viewers hold"
                );
            }
            globalsplat::eval::psnr_between(&splat, &copy, &cameras).unwrap().unwrap()
        };
        let (cut_off, fitted) = (psnr(&[]), psnr(&["--scene", arg(&room)]));
        assert!(fitted > cut_off + gain, "{ending}: {cut_off} dB cut off, {fitted} dB fitted");
    }
    // A message appears only without a capture.
    let (out, own) = (folder.path().join("b.spz"), folder.path().join("b.ply"));
    let said = |more: &[&str]| {
        let done = common::program::globalsplat(&[&["convert", arg(&strong), arg(&out)], more].concat());
        String::from_utf8(done.stderr).unwrap()
    };
    assert!(said(&[]).contains("beyond what the format holds"), "{}", said(&[]));
    assert!(said(&["--for-viewers"]).contains("beyond what viewers hold"), "{}", said(&["--for-viewers"]));
    assert_eq!(said(&["--scene", arg(&room)]), "");
    for to in [&out, &own] {
        let refine = ["refine", "--splat", arg(&strong), "--scene", arg(&room), "--steps", "1", "--out"];
        succeed(&[&refine[..], &[arg(to)]].concat());
    }
    let [small, large] = [&out, &own].map(|path| read_splat(path).unwrap());
    let psnr = globalsplat::eval::psnr_between(&large, &small, &cameras).unwrap().unwrap();
    let cut = fit_splat(&out, &large, &HarmonicLimits::up_to(3), &[]).unwrap();
    let cut_off = globalsplat::eval::psnr_between(&large, &cut, &cameras).unwrap().unwrap();
    assert!(psnr > cut_off + 6., "{psnr} dB, {cut_off} dB cut off");
}

/// Properties of three Gaussians in a PLY, by name.
type Columns = Vec<(&'static str, [f64; 3])>;

/// Returns the properties of a PLY, with the values of three Gaussians in a row.
fn small_gaussians() -> Columns {
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
fn write_ply(path: &Path, columns: &[(&str, [f64; 3])], types: &[(&str, &str)]) {
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

/// Returns standard error and standard output of a command that succeeds.
fn said(arguments: &[&str]) -> (String, String) {
    let done = common::program::globalsplat(arguments);
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    let (stdout, stderr) = (text(done.stdout), text(done.stderr));
    assert!(done.status.success(), "{arguments:?}: {stderr}");
    (stderr, stdout)
}

/// Rotations of length 0 are dropped by readers and writers, and counted, since the rasterizer doesn't draw such Gaussians.
#[test]
fn gaussians_without_a_rotation_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let splat = random_splat(300, 1, 11);
    let _ = splat.gaussians.quaternions.narrow(1, 100, 50).zero_();
    let made = Splat::of(&splat.gaussians).unwrap();
    assert_eq!(made.gaussians.count(), 250);
    assert_says(&made.warnings[0], &["50 of 300 Gaussians are left out", "length 0"]);
    for ending in ENDINGS {
        let copy = read_splat(&written(folder.path(), &format!("a.{ending}"), &splat)).unwrap();
        assert_eq!((copy.gaussians.count(), copy.warnings.len()), (250, 0), "{ending}");
    }
    // Files of other programs: zeros, and values that underflow, in a PLY; the middle of the byte range in a .splat.
    let mut columns = small_gaussians();
    columns.iter_mut().filter(|(name, _)| name.starts_with("rot")).for_each(|(_, values)| values[1] = 1e-40);
    let ply = folder.path().join("zero.ply");
    write_ply(&ply, &columns, &[]);
    let antimatter = written(folder.path(), "zero.splat", &random_splat(3, 0, 1));
    let mut bytes = std::fs::read(&antimatter).unwrap();
    bytes[32 + 28..64].fill(128);
    std::fs::write(&antimatter, bytes).unwrap();
    for path in [&ply, &antimatter] {
        let splat = read_splat(path).unwrap();
        assert_eq!(splat.gaussians.count(), 2);
        let line = "1 of 3 Gaussians are left out, whose rotations have length 0\n";
        let expected = format!("{}: {line}", path.display());
        let to = folder.path().join("b.spz");
        assert!(said(&["convert", arg(path), arg(&to)]).0.starts_with(&expected));
        assert_eq!(said(&["inspect", arg(path)]).0, expected);
        let views = folder.path().join("views.png");
        let render = ["render", "--splat", arg(path), "--orbit", "--frames", "1", "--size", "16x16", "--out"];
        assert_eq!(said(&[&render[..], &[arg(&views)]].concat()).0, expected);
    }
}

/// `convert` removes Gaussians with invalid values, and counts them; other commands refuse the file and name it.
#[test]
fn convert_repairs_what_others_refuse() {
    let (folder, room) = room();
    let write = |name: &str, change: &dyn Fn(&mut Columns)| {
        let path = folder.path().join(name);
        let mut columns = small_gaussians();
        columns.push(("f_rest_0", [0.1; 3]));
        columns.extend((1..9).map(|k| {
            (
                [
                    "", "f_rest_1", "f_rest_2", "f_rest_3", "f_rest_4", "f_rest_5", "f_rest_6", "f_rest_7",
                    "f_rest_8",
                ][k],
                [0.; 3],
            )
        }));
        change(&mut columns);
        write_ply(&path, &columns, &[]);
        path
    };
    let set = |columns: &mut Columns, name: &str, row: usize, value: f64| {
        columns.iter_mut().find(|(own, _)| *own == name).unwrap().1[row] = value;
    };
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
    .map(|(name, value)| (write(&format!("{name}.ply"), &|columns| set(columns, name, 1, value)), name, name))
    .collect();
    // .splat files have no property names, and SPZ's oldest version has half-precision floats.
    let antimatter = |name: &str, at: usize, value: f32| {
        let path = written(folder.path(), name, &random_splat(3, 0, 1));
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[32 + at..][..4].copy_from_slice(&value.to_le_bytes());
        std::fs::write(&path, bytes).unwrap();
        path
    };
    cases.push((antimatter("position.splat", 4, f32::NAN), "the position", "position"));
    cases.push((antimatter("infinite.splat", 12, f32::INFINITY), "the scale", "scale"));
    cases.push((antimatter("negative.splat", 20, -0.1), "the scale", "scale"));
    let head = [b"NGSP", &[1, 0, 0, 0, 3, 0, 0, 0, 0, 12, 0, 0][..]].concat();
    let halves = [0x3c00u16, 0x3c00, 0x4400, 0x3c00, 0x7e00, 0x4400, 0xbc00, 0x3c00, 0x4400];
    let rest = [vec![200; 3], vec![128; 9], vec![130; 9], vec![128; 9]].concat();
    let spz = folder.path().join("half.spz");
    std::fs::write(&spz, gzip(&[head, halves.map(u16::to_le_bytes).concat(), rest].concat())).unwrap();
    cases.push((spz, "the position", "position"));
    for (index, (path, field, property)) in cases.iter().enumerate() {
        let (picture, out) = (folder.path().join("orbit.png"), folder.path().join("refined.ply"));
        let render = ["render", "--splat", arg(path), "--orbit", "--out", arg(&picture)];
        let refine = ["refine", "--splat", arg(path), "--scene", arg(&room), "--out", arg(&out)];
        let eval = ["eval", "--splat", arg(path), "--scene", arg(&room)];
        let commands = [&["inspect", arg(path)][..], &render, &refine, &eval];
        for arguments in &commands[..if index == 0 { 4 } else { 1 }] {
            assert_says(&refuse(arguments), &[field, "`globalsplat convert` leaves out"]);
        }
        for ending in &ENDINGS[if index == 0 { 0..4 } else { index % 4..index % 4 + 1 }] {
            let to = folder.path().join(format!("repaired.{ending}"));
            let (warnings, _) = said(&["convert", arg(path), arg(&to)]);
            let expected = format!(
                "{}: 1 of 3 Gaussians are left out, whose numbers aren't finite or are out of range: {property}",
                path.display()
            );
            assert_eq!(warnings.lines().next(), Some(&*expected), "{ending}");
            assert_eq!(read_splat(&to).unwrap().gaussians.count(), 2, "{ending}");
        }
    }
    // Each property is named once, up to a maximum number; a Gaussian counts once.
    let many = write("many.ply", &|columns| {
        columns.iter_mut().for_each(|(_, values)| values[0] = f64::NAN);
        set(columns, "y", 2, f64::NAN);
    });
    let repaired = read_splat_without_invalid(&many).unwrap();
    assert_says(
        &repaired.warnings[0],
        &["2 of 3 Gaussians", ": x, y, z, f_dc_0, f_dc_1, f_dc_2 and 17 more"],
    );
    let none =
        write("none.ply", &|columns| columns.iter_mut().for_each(|(_, values)| *values = [f64::NAN; 3]));
    let to = folder.path().join("none.spz");
    assert_says(
        &refuse(&["convert", arg(&none), arg(&to)]),
        &["the number of Gaussians is 3, none of which"],
    );
}

/// An invalid bound of a chunk of a compressed PLY makes all of the chunk's Gaussians invalid.
#[test]
fn compressed_gaussians_without_bounds_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let path = written(folder.path(), "a.compressed.ply", &random_splat(300, 0, 4));
    let mut bytes = std::fs::read(&path).unwrap();
    let body = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    bytes[body + 4..][..4].copy_from_slice(&f32::NAN.to_le_bytes());
    std::fs::write(&path, bytes).unwrap();
    let repaired = read_splat_without_invalid(&path).unwrap();
    assert_eq!(repaired.gaussians.count(), 44);
    assert_says(&repaired.warnings[0], &["256 of 300 Gaussians are left out", ": min_y"]);
}

/// 2DGS has no third scale: its Gaussians are flat, in every format, down to each format's smallest scale.
#[test]
fn surfels_are_flat() {
    let folder = tempfile::tempdir().unwrap();
    let mut columns = small_gaussians();
    columns.retain(|(name, _)| *name != "scale_2");
    let surfels = folder.path().join("surfels.ply");
    write_ply(&surfels, &columns, &[]);
    let splat = read_splat(&surfels).unwrap();
    assert_says(&splat.warnings[0], &["surfels.ply: Gaussians are flat", "scale_2"]);
    let third = |splat: &Splat| splat.gaussians.scales.select(2, 2).max().double_value(&[]);
    assert!(third(&splat) > 0. && third(&splat) <= 1.1e-30, "{}", third(&splat));
    // From the side only the rasterizer's blur is visible: a smaller scale makes no difference.
    let mut thinnest = Splat::of(&splat.gaussians).unwrap();
    thinnest.gaussians.scales = splat.gaussians.scales.copy();
    let _ = thinnest.gaussians.scales.select(2, 2).zero_();
    assert!(psnr_of_pictures(&splat, &thinnest, camera()) > 90.);
    for (ending, flat) in [("ply", 1.1e-30), ("compressed.ply", 2.1e-9), ("spz", 4.6e-5), ("splat", 1.1e-30)]
    {
        let to = folder.path().join(format!("a.{ending}"));
        let (warnings, _) = said(&["convert", arg(&surfels), arg(&to)]);
        assert_eq!(warnings.lines().count(), 1, "{warnings}");
        let copy = read_splat(&to).unwrap();
        assert!(third(&copy) <= flat, "{ending}: {}", third(&copy));
        let psnr = psnr_of_pictures(&splat, &copy, camera());
        assert!(psnr > 35., "{ending}: {psnr} dB");
    }
}

/// Colours instead of spherical harmonics are read, whatever their type and their names.
#[test]
fn colours_are_harmonics_of_degree_0() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("colours.ply");
    let bytes = [[0., 255., 10.], [128., 3., 20.], [255., 77., 30.]];
    let largest = |of: &str| match of {
        "uchar" => 255.,
        "ushort" => 65535.,
        _ => 1.,
    };
    for names in [["red", "green", "blue"], ["r", "g", "b"], ["diffuse_red", "diffuse_green", "diffuse_blue"]]
    {
        for (of, whole) in
            [("uchar", 255.), ("ushort", 65535.), ("float", 1.), ("float", 255.), ("double", 1.)]
        {
            let mut columns = small_gaussians();
            columns.retain(|(name, _)| !name.starts_with("f_dc"));
            columns
                .extend(names.into_iter().zip(bytes.map(|of_rows| of_rows.map(|byte| byte / 255. * whole))));
            write_ply(&path, &columns, &names.map(|name| (name, of)));
            let splat = read_splat(&path).unwrap();
            assert_says(&splat.warnings[0], &[&names.join(", "), "f_dc_*"]);
            let expected: Vec<f64> = (0..3)
                .flat_map(|row| bytes.map(|of_rows| (of_rows[row] / 255. - 0.5) / 0.28209479177387814))
                .collect();
            let expected = Tensor::from_slice(&expected).view([1, 3, 1, 3]);
            let step = if largest(of) == 65535. { 1e-4 } else { 1e-6 };
            let error = largest_error(&splat.gaussians.sh, &expected);
            assert!(error < step, "{of} {names:?} of {whole}: {error}");
            // If there are coefficients as well, another program derived the colours from them, and they are ignored.
            columns.extend(small_gaussians().into_iter().filter(|(name, _)| name.starts_with("f_dc")));
            write_ply(&path, &columns, &names.map(|name| (name, of)));
            let splat = read_splat(&path).unwrap();
            assert!(splat.warnings.is_empty() && splat.gaussians.sh.double_value(&[0, 0, 0, 0]) == 1.);
        }
    }
}

/// A PLY without the properties that make Gaussians of points is reported as a point cloud.
#[test]
fn point_clouds_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("points.ply");
    let mut columns = small_gaussians();
    columns.retain(|(name, _)| name.len() == 1);
    columns.extend(["red", "green", "blue"].map(|name| (name, [200.; 3])));
    write_ply(&path, &columns, &["red", "green", "blue"].map(|name| (name, "uchar")));
    let told = ["points.ply: the element vertex is a point cloud, without opacity, scale_* and rot_*"];
    assert_says(&refuse(&["inspect", arg(&path)]), &told);
    for absent in ["opacity", "scale_0", "rot_2", "f_dc_1"] {
        let mut columns = small_gaussians();
        columns.retain(|(name, _)| *name != absent);
        write_ply(&path, &columns, &[]);
        assert_says(&refuse(&["inspect", arg(&path)]), &[&format!("property {absent} is absent")]);
    }
}

/// Lengths of quaternions are ignored, in every format: rotations are read back with length 1.
#[test]
fn quaternions_of_any_length_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let splat = random_splat(257, 0, 12);
    for length in [1e-36, 1e-20, 1e-4, 1e4, 1e20, 2e38] {
        let mut other = random_splat(257, 0, 12);
        let _ = other.gaussians.quaternions.g_mul_scalar_(length);
        for ending in ENDINGS {
            let copy = read_splat(&written(folder.path(), &format!("a.{ending}"), &other)).unwrap();
            assert_eq!(
                (copy.gaussians.count(), copy.warnings.len()),
                (257, 0),
                "{ending}, length {length:e}"
            );
            let what = format!("{ending} with quaternions of length {length:e}");
            assert_within(&what, &splat, &copy, &steps(ending, 257));
        }
    }
}
