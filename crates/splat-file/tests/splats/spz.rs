//! SPZ: all versions, and invalid files. Niantic's library reads what is written in parity/tests/test_splat_formats.py.

use super::common::{
    assert_bytes_refused, assert_changes_refused, assert_says, assert_within, largest_error, random_splat,
    read_bytes, round_trip,
};
use glam::DMat4;
use globalsplat_splat_file::{Splat, WriteOptions, write_local_splat, write_splat};
use std::f64::consts::FRAC_PI_2;
use std::io::{Read, Write};

/// Returns the bytes of an SPZ of a version.
fn bytes_of_version(spz_version: u32, splat: &Splat) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    write_local_splat(&path, splat, &WriteOptions { spz_version }).unwrap();
    std::fs::read(path).unwrap()
}

/// Each version that is written gives the same Gaussians when it is read, up to version 2's rotations.
#[test]
fn all_versions_are_written() {
    let splat = random_splat(300, 3, 4);
    let [two, three, four] =
        [2, 3, 4].map(|version| read_bytes("spz", &bytes_of_version(version, &splat)).unwrap());
    assert_eq!(three, four);
    assert_within("version 2", &four, &two, [0., 0., 0.1, 0., 0., 0., 0.]);
    for spz_version in [1, 5] {
        let path = std::path::Path::new("none.spz");
        let error = write_local_splat(path, &splat, &WriteOptions { spz_version }).unwrap_err();
        assert_says(&error.to_string(), &["the version of SPZ", "expected 2 to 4"]);
        assert!(!path.exists());
    }
}

/// Streams of a Gaussian: positions 1, 2 and 3 with 12 fractional bits, opacity, color and scale, rotation, spherical harmonics.
const POSITIONS: &[u8] = b"\x00\x10\x00\x00\xe0\xff\x00\xd0\xff";
const SHAPE: &[u8] = b"\x9f\x83\x87\x8b\x90\x80\x70";
const ROTATION: &[u8] = b"\xde\x52\xaa\xc4";
const HARMONICS: &[u8] = b"\x70\x68\x58\x50\x40\x30\xd8\xe8\xf0";

/// Returns the header of a Gaussian of SH degree 1 in a version before 4.
fn head_of_one(version: u8, flags: u8) -> Vec<u8> {
    [b"NGSP", &[version, 0, 0, 0, 1, 0, 0, 0, 1, 12, flags, 0][..]].concat()
}

/// Each of the four versions of SPZ gives the same Gaussian, from bytes written by the format's documentation.
#[test]
fn older_versions_of_spz_are_read() {
    // Positions as half-precision floats; x, y and z of the rotation in a byte each.
    let (halves, xyz) = ([0x3c00u16, 0xc000, 0xc200].map(u16::to_le_bytes).concat(), b"\x8d\x65\x58");
    let one = [&head_of_one(1, 0), &halves, SHAPE, xyz, HARMONICS].concat();
    let two = [&head_of_one(2, 0), POSITIONS, SHAPE, xyz, HARMONICS].concat();
    let three = [&head_of_one(3, 0), POSITIONS, SHAPE, ROTATION, HARMONICS].concat();
    // File written by Niantic's library.
    let four = include_bytes!("../files/version_4.spz").to_vec();
    for (version, bytes) in [(1, gzip(&one)), (2, gzip(&two)), (3, gzip(&three)), (4, four)] {
        let splat = read_bytes("spz", &bytes).unwrap_or_else(|e| panic!("{e}"));
        let near = |found: &[f32], expected: &[f32], step: f64| {
            let error = largest_error(found, expected);
            assert!(error <= step, "version {version}: {found:?}, not {expected:?}");
        };
        near(&splat.means[0], &[1., 2., 3.], 0.);
        near(&splat.log_scales[0], &[-1., -2., -3.], 1. / 32.);
        let length = 0.95f32.sqrt();
        near(&splat.quaternions[0], &[0.9 / length, 0.1 / length, 0.2 / length, 0.3 / length], 0.006);
        near(&[splat.opacity(0)], &[0.622_459], 0.51 / 255.);
        let expected = [0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9];
        near(splat.sh.as_flattened(), &expected, 1. / 32. + 1e-6);
    }
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(vec![], flate2::Compression::default());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

fn unfolded(gzipped: &[u8]) -> Vec<u8> {
    let mut bytes = vec![];
    flate2::bufread::GzDecoder::new(gzipped).read_to_end(&mut bytes).unwrap();
    bytes
}

/// The axes that an extension of an SPZ names are applied: here those of PLYs, for which no sign changes.
#[test]
fn the_axes_of_an_spz_are_applied() {
    let with_axes = |number: u32| {
        let extension = [0xADBE_0003u32, 4, number].map(u32::to_le_bytes).concat();
        let unknown = [0x1234_0001u32, 4, 0].map(u32::to_le_bytes).concat();
        let head = head_of_one(3, 2);
        gzip(&[&head, POSITIONS, SHAPE, ROTATION, HARMONICS, &unknown, &extension].concat())
    };
    let [rub, rdf] = [4, 6].map(|number| read_bytes("spz", &with_axes(number)).unwrap());
    let [x, y, z] = rub.means[0];
    assert_eq!(rdf.means[0], [x, -y, -z]);
    let [w, x, y, z] = rub.quaternions[0];
    assert_eq!(rdf.quaternions[0], [w, x, -y, -z]);
    // The order of degree 1 is y, z, x.
    let signed = [(0, 1f32), (1, -1.), (2, -1.), (3, 1.)];
    assert_eq!(rdf.sh, signed.map(|(basis, sign)| rub.sh[basis].map(|channel| sign * channel)));
    // The others are a quarter turn away: 12 is RFU, right, forward and up.
    let [x, y, z] = rdf.means[0];
    assert_eq!(read_bytes("spz", &with_axes(12)).unwrap().means[0], [x, -z, y]);
    for number in 1..=8 {
        let [plain, turned] = [0, 8].map(|more| read_bytes("spz", &with_axes(number + more)).unwrap());
        let quarter_turn = DMat4::from_rotation_x(-FRAC_PI_2);
        assert_within("axes", &plain.transformed(&quarter_turn).unwrap(), &turned, [1e-6; 7]);
    }
    assert_bytes_refused("spz", &with_axes(17), &["the coordinate system is 17", "1 to 16"]);
}

/// The reader keeps the finest of Spark's levels of detail: Gaussians without children, whose opacities are stored as halves.
#[test]
fn the_finest_level_of_detail_is_read() {
    let mut bytes = unfolded(&bytes_of_version(3, &random_splat(3, 1, 9)));
    let plain = read_bytes("spz", &gzip(&bytes)).unwrap();
    bytes[14] |= 0x80;
    let message = ["the body is cut short: 87 bytes, expected 105 bytes for 3 Gaussians"];
    assert_bytes_refused("spz", &gzip(&bytes), &message);
    // Numbers of children, and indices of the first ones.
    bytes.extend([0u16, 2, 0].map(u16::to_le_bytes).concat());
    bytes.extend([0u32, 2, 0].map(u32::to_le_bytes).concat());
    let read = read_bytes("spz", &gzip(&bytes)).unwrap();
    let leaves = plain.select(&[0, 2]);
    for index in 0..2 {
        assert!((read.opacity(index) - (2. * leaves.opacity(index)).min(1.)).abs() < 1e-6);
    }
    assert_says(
        &read.warnings[0],
        &["a.spz: 1 of 3 Gaussians are left out, which are Spark's coarser levels of detail"],
    );
    let mut coarse = bytes.clone();
    let children = coarse.len() - 3 * 6;
    coarse[children..][..6].fill(1);
    assert_bytes_refused("spz", &gzip(&coarse), &["the number of Gaussians is 0, expected 1 or more"]);
    let same = Splat { opacity_logits: leaves.opacity_logits.clone(), warnings: vec![], ..read };
    assert_eq!(same, leaves);
    let mut four = bytes_of_version(4, &random_splat(3, 1, 9));
    four[14] |= 0x80;
    assert_bytes_refused(
        "spz",
        &four,
        &["the flags is 128, Spark's levels of detail, expected none in version 4"],
    );
}

#[test]
fn bad_spzs() {
    let gzipped = bytes_of_version(3, &random_splat(300, 1, 9));
    let unfolded = unfolded(&gzipped);
    for (at, byte, message) in [
        (0, b'n', "the first bytes is"),
        (4, 4, "the version is 4, expected 1 to 3 in gzip"),
        (12, 4, "the SH degree is 4, expected 0 to 3"),
        (13, 31, "fractional bits is 31, expected 0 to 30"),
        (8, 45, "the body is cut short"),
        (11, 59, "256 times the file's"),
    ] {
        let mut inside = unfolded.clone();
        inside[at] = byte;
        assert_bytes_refused("spz", &gzip(&inside), &[message]);
    }
    assert_bytes_refused("spz", &gzip(&unfolded[..9]), &["the header is 9 bytes"]);
    let mut bomb = unfolded.clone();
    bomb[8..12].copy_from_slice(&400_000u32.to_le_bytes());
    bomb.resize(6_000_000, 0);
    assert_bytes_refused("spz", &gzip(&bomb), &["the number of Gaussians is 400000"]);
    let mut extended = [unfolded, vec![3, 0, 0xbe, 0xad, 9, 0, 0, 0, 6]].concat();
    extended[14] = 2;
    let message = ["an extension is cut short: 1 bytes, expected 9 bytes"];
    assert_bytes_refused("spz", &gzip(&extended), &message);
    assert_bytes_refused("spz", &gzipped[..100], &["damaged", "a whole gzip"]);
    let mut damaged = gzipped.clone();
    *damaged.last_mut().unwrap() ^= 1;
    assert_bytes_refused("spz", &damaged, &["the file is damaged"]);
    assert_bytes_refused("spz", b"no gzip", &["the file is no SPZ"]);
}

/// A table of contents that doesn't match the data is refused.
#[test]
fn bad_spzs_of_version_4() {
    let head = [b"NGSP", &[4, 0, 0, 0, 1, 0, 0, 0, 0, 12, 0, 5, 32, 0, 0, 0][..], &[0; 12]].concat();
    let streams = [9, 1, 3, 3, 4].map(|length| zstd::encode_all(&vec![128; length][..], 1).unwrap());
    let entries = streams.iter().flat_map(|one| [(one.len() as u64).to_le_bytes(), [0; 8]].concat());
    let whole = [head, entries.collect(), streams.concat()].concat();
    assert_bytes_refused("spz", &whole[..20], &["the header is 20 bytes, expected 32"]);
    let cases: [(usize, &[u8], &str); 9] = [
        (4, &[3], "the version is 3, expected 1 to 3 in gzip, 4 outside of it"),
        (15, &[200], "the table of contents is at 32, expected 200 entries"),
        (16, &[255; 4], "the table of contents is at 4294967295"),
        (15, &[4], "stream"),
        (32, &[255; 8], "stream 0 is cut short"),
        (8, &[2], "stream 0 is 9 bytes or more, expected 18 bytes for 2"),
        (12, &[1], "stream 5 is missing, expected one of 9 bytes"),
        (32 + 5 * 16, &[0], "stream 0 is damaged"),
        (8, &[255; 4], "the number of Gaussians is 4294967295"),
    ];
    assert_changes_refused("spz", &whole, &cases);
}

/// Positions that 24 bits can't hold are refused, and nothing is written. Values that nearly exceed the range are as exact as 24 bits
/// allow.
#[test]
fn positions_have_24_bits() {
    let folder = tempfile::tempdir().unwrap();
    let mut far = random_splat(3, 1, 1);
    far.means[1] = [1e7; 3];
    let error = write_splat(&folder.path().join("a.spz"), &far).unwrap_err().to_string();
    assert_says(&error, &["a coordinate is 10000000, expected at most 8388607"]);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    far.means[1] = [-8_388_000.; 3];
    let near = round_trip("spz", &far);
    assert!(largest_error(near.means.as_flattened(), far.means.as_flattened()) <= 0.5);
}
