//! Invalid files, and files of which only a part of the Gaussians can be drawn.

use super::common::{
    ENDINGS, assert_bytes_refused, assert_refused, assert_says, body_of_ply, bytes_of,
    files_with_invalid_values, files_without_a_rotation, random_splat, read_bytes, round_trip, set,
    small_gaussians, write_changed_ply, write_ply,
};
use globalsplat_splat_file::{read_splat, read_splat_without_invalid, write_splat};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};

/// Replaces a part of a header.
fn replace(bytes: &mut Vec<u8>, from: &str, to: &str) {
    let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
    bytes.splice(at..at + from.len(), to.bytes());
}

/// Checks the errors for files of `ending` after a change of a header, each with what is replaced, its replacement and the error.
fn assert_headers_are_refused(ending: &str, cases: &[(&str, &str, &str)]) {
    let whole = bytes_of(ending, &random_splat(300, 1, 9));
    for (from, to, message) in cases {
        let mut bytes = whole.clone();
        replace(&mut bytes, from, to);
        assert_bytes_refused(ending, &bytes, &[message]);
    }
}

#[test]
fn bad_plys() {
    let huge = "vertex 18446744073709551615";
    let faces = "element face 1000000000000\nproperty list uchar int i\nelement vertex";
    let cases = [
        ("little", "middle", "the format is binary_middle_endian"),
        ("format", "comment", "the line format is missing"),
        ("vertex 300", "vertex many", "rows of the element vertex is many, expected a whole number"),
        ("element vertex 300\n", "", "the property x is without an element"),
        ("end_header", "end_headers", "the header is without its end, expected a line end_header"),
        ("element vertex", "element point", "the element vertex is missing"),
        ("float opacity", "float half opacity", "the type of opacity is \"float half\""),
        ("float opacity", "list float opacity", "the type of opacity"),
        ("float opacity", "list uchar float opacity", "property opacity is a list"),
        ("f_rest_8", "f_rest_9", "f_rest_* is 8 properties"),
        ("vertex 300", huge, "x in row 300 of vertex is cut short, expected numbers"),
        ("binary_little_endian", "ascii", "in row 0 of vertex is"),
        ("element vertex", faces, "of face is cut short, expected numbers in 1000000000000 rows"),
    ];
    assert_headers_are_refused("ply", &cases);
    assert_bytes_refused("ply", b"hello", &["the file is no PLY"]);
    for ending in ["ply", "compressed.ply"] {
        let mut bytes = bytes_of(ending, &random_splat(300, 1, 9));
        let size = bytes.len();
        bytes.extend(b"\0\n");
        assert_eq!(read_bytes(ending, &bytes).unwrap().len(), 300);
        // As many rows again, or bytes of a row that the header leaves out.
        bytes.extend_from_within(size - 600..size);
        let message =
            format!("the size is {} bytes, expected {size}, where the header's elements end", size + 602);
        assert_bytes_refused(ending, &bytes, &[&message]);
    }
    // NUL after the last number of a text.
    let folder = tempfile::tempdir().unwrap();
    let path = write_changed_ply(folder.path(), "text.ply", |_| ());
    let text = std::fs::read(&path).unwrap();
    std::fs::write(&path, [text.trim_ascii_end(), b"\0\0"].concat()).unwrap();
    assert_eq!(read_splat(&path).unwrap().len(), 3);
    for (length, message) in [
        (-1., "i in row 0 of face is a list of the length -1, expected numbers"),
        (f64::NAN, "i in row 0 of face is a list of the length NaN"),
        (1e300, "i in row 0 of face is cut short"),
    ] {
        let mut bytes = bytes_of("ply", &random_splat(3, 1, 9));
        replace(&mut bytes, "element vertex", "element face 1\nproperty list double int i\nelement vertex");
        let body = body_of_ply(&bytes);
        bytes.splice(body..body, f64::to_le_bytes(length));
        assert_bytes_refused("ply", &bytes, &[message]);
    }
}

#[test]
fn bad_compressed_plys() {
    // Other elements have the bytes of the rows that are missing.
    let one_chunk = "element other 72\nproperty uchar a\nelement chunk 1";
    let fewer_rows = "element other 9\nproperty uchar a\nelement sh 299";
    let cases = [
        ("element chunk", "element chunks", "the element chunk is missing"),
        ("element chunk 2", one_chunk, "the number of chunks is 1, expected 2 for 300"),
        ("vertex 300", "vertex 4000000000", "of vertex is cut short, expected numbers in 4000000000 rows"),
        ("float max_b", "float most_b", "property max_b is missing"),
        ("uint packed_scale", "int packed_scale", "property packed_scale is of another type, expected uint"),
        ("uchar f_rest_3", "char f_rest_3", "property f_rest_3 is of another type, expected uchar"),
        ("element sh 300", fewer_rows, "rows of the element sh is 299, expected 300"),
        ("uchar f_rest_8", "uchar f_rest_x", "f_rest_* is 8 properties"),
    ];
    assert_headers_are_refused("compressed.ply", &cases);
}

#[test]
fn bad_splats() {
    assert_bytes_refused("splat", &[0; 33], &["the length is 33 bytes", "32 bytes for each"]);
    assert_bytes_refused("splat", &[], &["the length is 0 bytes"]);
}

/// No truncated or changed file of any format makes its reader panic, or allocate what the file can't hold.
#[test]
fn random_changes_are_read_or_refused() {
    let mut random = StdRng::seed_from_u64(8);
    let splat = random_splat(40, 1, 9);
    let mut files = Vec::from(ENDINGS.map(|ending| (ending, bytes_of(ending, &splat))));
    files.push(("ksplat", include_bytes!("../files/level_1.ksplat").to_vec()));
    for (ending, whole) in files {
        for round in 0..100 {
            let mut bytes = whole.clone();
            // Headers are at the beginning of most files.
            let limit = if round % 2 == 0 { bytes.len().min(512) } else { bytes.len() };
            for _ in 0..3 {
                bytes[random.random_range(0..limit)] = random.random();
            }
            if round % 4 == 0 {
                bytes.truncate(random.random_range(0..bytes.len()));
            }
            if let Err(error) = read_bytes(ending, &bytes) {
                assert_eq!(error.to_string().lines().count(), 1, "{error}");
                assert!(error.is_invalid_request(), "{error}");
            }
        }
    }
}

/// Values that a format can't store are refused, and nothing is written.
#[test]
fn numbers_that_a_format_cannot_store_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for ending in ENDINGS {
        let path = folder.path().join(format!("a.{ending}"));
        let mut changed = [(); 5].map(|()| random_splat(3, 1, 1));
        changed[0].means[1] = [f32::NAN; 3];
        changed[1].log_scales[2][1] = f32::INFINITY;
        changed[2].quaternions[0][3] = f32::INFINITY;
        changed[3].opacity_logits[1] = f32::NAN;
        changed[4].sh[5][0] = f32::NEG_INFINITY;
        for splat in changed {
            let error = write_splat(&path, &splat).unwrap_err();
            assert_says(&error.to_string(), &["numbers that aren't finite"]);
            assert!(!error.is_invalid_request());
        }
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// Rotations of length 0 are dropped by readers and writers, and counted, since the rasterizer doesn't draw such Gaussians.
#[test]
fn gaussians_without_a_rotation_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let mut splat = random_splat(300, 1, 11);
    splat.quaternions[100..150].fill([0.; 4]);
    let drawable = splat.clone().without_missing_rotations("the splat");
    assert_eq!(drawable.len(), 250);
    let expected = "the splat: 50 of 300 Gaussians are left out, whose rotations have length 0";
    assert_eq!(drawable.warnings, [expected]);
    for ending in ENDINGS {
        let copy = round_trip(ending, &splat);
        assert_eq!((copy.len(), copy.warnings.len()), (250, 0), "{ending}");
    }
    for path in &files_without_a_rotation(folder.path()) {
        let splat = read_splat(path).unwrap();
        assert_eq!(splat.len(), 2);
        let message = "1 of 3 Gaussians are left out, whose rotations have length 0";
        assert_eq!(splat.warnings, [format!("{}: {message}", path.display())]);
    }
}

/// Gaussians with invalid values are refused with the field's name, or left out and counted.
#[test]
fn invalid_values_are_refused_or_left_out() {
    let folder = tempfile::tempdir().unwrap();
    for (path, field, property) in files_with_invalid_values(folder.path()) {
        assert_refused(&path, &[field, "`globalsplat convert` leaves out"]);
        let repaired = read_splat_without_invalid(&path).unwrap();
        assert_eq!(repaired.len(), 2);
        let expected = format!(
            "{}: 1 of 3 Gaussians are left out, whose numbers aren't finite or are out of range: {property}",
            path.display()
        );
        assert_eq!(repaired.warnings, [expected]);
        for ending in ENDINGS {
            let copy = round_trip(ending, &repaired);
            assert_eq!((copy.len(), copy.warnings.len()), (2, 0), "{ending}");
        }
    }
    // Each property is named once, up to a maximum number; a Gaussian counts once.
    let many = write_changed_ply(folder.path(), "many.ply", |columns| {
        columns.iter_mut().for_each(|(_, values)| values[0] = f64::NAN);
        set(columns, "y", 2, f64::NAN);
    });
    let repaired = read_splat_without_invalid(&many).unwrap();
    assert_says(
        &repaired.warnings[0],
        &["2 of 3 Gaussians", ": x, y, z, f_dc_0, f_dc_1, f_dc_2 and 17 more"],
    );
    let none = write_changed_ply(folder.path(), "none.ply", |columns| {
        columns.iter_mut().for_each(|(_, values)| *values = [f64::NAN; 3]);
    });
    let error = read_splat_without_invalid(&none).unwrap_err().to_string();
    assert_says(&error, &["the number of Gaussians is 3, none of which"]);
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
    let message = ["points.ply: the element vertex is a point cloud, without opacity, scale_* and rot_*"];
    assert_refused(&path, &message);
    for absent in ["opacity", "scale_0", "rot_2", "f_dc_1"] {
        let mut columns = small_gaussians();
        columns.retain(|(name, _)| *name != absent);
        write_ply(&path, &columns, &[]);
        assert_refused(&path, &[&format!("property {absent} is missing")]);
    }
}
