//! mkkellogg's .ksplat: values of every compression level, and invalid files. This project doesn't write the format: `files/` has a file of
//! each level, built by the format's description, of three sections of SH degrees 1, 3 and 0 with full and partial buckets, and one with
//! a range of coefficients, each beside a PLY of the same Gaussians.

mod common;

use common::{assert_says, largest_error, refused_file};
use globalsplat_splat_file::{
    check_writable_splat, is_splat_name, limits_of, read_splat, read_splat_without_invalid, write_splat,
};
use std::path::Path;

/// Size of the header of a file, and of a section.
const HEADER: usize = 4096;
const SECTION_HEADER: usize = 1024;
/// Number of Gaussians in `level_1.ksplat`.
const COUNT: usize = 33;

fn files() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/files")
}

/// Every level is read, with the buckets, the order of the spherical harmonics and the defaults of the format.
#[test]
fn ksplats_are_read() {
    for name in ["level_0", "level_1", "level_2", "range"] {
        let [splat, expected] =
            ["ksplat", "ply"].map(|ending| read_splat(&files().join(format!("{name}.{ending}"))).unwrap());
        assert_eq!((&splat.means, &splat.quaternions), (&expected.means, &expected.quaternions), "{name}");
        assert_eq!((&splat.log_scales, &splat.sh), (&expected.log_scales, &expected.sh), "{name}");
        // A PLY has no opacity of exactly 1.
        let [own, other] = [&splat, &expected]
            .map(|splat| (0..splat.len()).map(|index| splat.opacity(index)).collect::<Vec<_>>());
        assert!(largest_error(&own, &other) < 2e-6, "{name}");
        assert!(splat.warnings.is_empty() && !splat.antialiased);
    }
}

#[test]
fn half_precision_numbers_are_exact() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ksplat");
    let whole = std::fs::read(files().join("level_1.ksplat")).unwrap();
    // Three sections, two lengths of partial buckets, four centres and a position precede the first scale.
    let scale = HEADER + 3 * SECTION_HEADER + 2 * 4 + 4 * 12 + 6;
    let write = |at: usize, bits: u16| {
        let mut bytes = whole.clone();
        bytes[at..at + 2].copy_from_slice(&bits.to_le_bytes());
        std::fs::write(&path, bytes).unwrap();
    };
    for (bits, expected) in [
        (0x0001, 2f32.powi(-24)),
        (0x03ff, 1023. * 2f32.powi(-24)),
        (0x0400, 2f32.powi(-14)),
        (0, 0.),
        (0x3555, 0.333_251_95),
        (0x7bff, 65504.),
    ] {
        write(scale, bits);
        assert_eq!(read_splat(&path).unwrap().scale(0)[0], expected);
    }
    for (at, bits, found) in [
        (scale, 0x7c00, "the scale of Gaussian 0 is inf,"),
        (scale, 0xbc00, "the scale of Gaussian 0 is -1,"),
        (scale + 6, 0x7e00, "the rotation of Gaussian 0 is NaN,"),
    ] {
        write(at, bits);
        assert_says(&refused_file(&path), &[found]);
        assert_eq!(read_splat_without_invalid(&path).unwrap().len(), COUNT - 1);
    }
}

#[test]
fn bad_ksplats() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ksplat");
    let whole = std::fs::read(files().join("level_1.ksplat")).unwrap();
    const ALL: [u8; 4] = [255; 4];
    for (at, number, message) in [
        (0, &[1][..], "the version is 1.1, expected 0.1"),
        (20, &[3], "the compression level is 3, expected 0 to 2"),
        (4, &ALL, "the number of sections is 4294967295"),
        (16, &[23], "the number of Gaussians is 23, with 33 in the sections"),
        (HEADER, &[12], "the number of Gaussians of section 0 is 12, expected 11 at most"),
        (HEADER + 4, &ALL, "the body of section 0 is cut short"),
        (HEADER + 12, &ALL, "the body of section 0 is cut short"),
        (HEADER + 36, &ALL, "the body of section 0 is cut short"),
        (HEADER + 12, &[3], "the number of buckets of section 0 is 3, expected 2 full and 2"),
        (HEADER + 32, &ALL, "expected 4294967295 full and 2 partially filled ones"),
        (HEADER + 20, &[10], "the size of a bucket of section 0 is 10, expected 12 bytes"),
        (HEADER + 8, &[3], "the number of Gaussians in the buckets of section 0 is 9, expected 11"),
        (HEADER + SECTION_HEADER + 40, &[4], "the SH degree is 4, expected 0 to 3"),
        (HEADER + 16, &[0, 0, 128, 127], "the position of Gaussian 0 is"),
    ] {
        let mut bytes = whole.clone();
        bytes[at..at + number.len()].copy_from_slice(number);
        std::fs::write(&path, bytes).unwrap();
        assert_says(&refused_file(&path), &[message]);
    }
    for length in (0..whole.len()).step_by(97) {
        std::fs::write(&path, &whole[..length]).unwrap();
        refused_file(&path);
    }
}

/// The format is only read: every function that writes says so before it writes.
#[test]
fn ksplats_are_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ksplat");
    let errors = [
        write_splat(&path, &common::random_splat(3, 0, 1)).unwrap_err(),
        check_writable_splat(&path).unwrap_err(),
        limits_of(&path).unwrap_err(),
    ];
    for error in errors {
        assert!(error.is_invalid_request());
        let message = "the format is .ksplat, which is only read, expected .ply, .compressed.ply, .sog, .spz";
        assert_says(&error.to_string(), &[message]);
    }
    assert!(!path.exists() && is_splat_name(&path));
}
