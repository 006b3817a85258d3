//! mkkellogg's .ksplat: values of every compression level, and invalid files. This project doesn't write the format: `files/` has a file of
//! each level, built by the format's description, of three sections of SH degrees 1, 3 and 0 with full and partial buckets, and one with
//! a range of coefficients, each beside a PLY of the same Gaussians.

use super::common::{assert_bytes_refused, assert_says, largest_error, random_splat, read_bytes, refusal};
use globalsplat_splat_file::{check_writable_splat, is_splat_name, output_format, read_splat, write_splat};
use std::path::{Path, PathBuf};

/// Size of the header of a file, and of a section.
const HEADER: usize = 4096;
const SECTION_HEADER: usize = 1024;

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/files").join(name)
}

/// Every level is read, with the buckets, the order of the spherical harmonics and the defaults of the format.
#[test]
fn ksplats_are_read() {
    for name in ["level_0", "level_1", "level_2", "range"] {
        let [splat, expected] =
            ["ksplat", "ply"].map(|ending| read_splat(&file(&format!("{name}.{ending}"))).unwrap());
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
fn bad_ksplats() {
    let whole = std::fs::read(file("level_1.ksplat")).unwrap();
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
    ] {
        let mut bytes = whole.clone();
        bytes[at..at + number.len()].copy_from_slice(number);
        assert_bytes_refused("ksplat", &bytes, &[message]);
    }
    for length in (0..whole.len()).step_by(97) {
        refusal(read_bytes("ksplat", &whole[..length]));
    }
}

/// The format is only read: every function that writes says so before it writes.
#[test]
fn ksplats_are_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ksplat");
    let errors = [
        write_splat(&path, &random_splat(3, 0, 1)).unwrap_err(),
        check_writable_splat(&path).unwrap_err(),
        output_format(&path).err().unwrap(),
    ];
    for error in errors {
        assert!(error.is_invalid_request());
        let message = "the format is .ksplat, which is only read, expected .ply, .compressed.ply, .sog, .spz";
        assert_says(&error.to_string(), &[message]);
    }
    assert!(!path.exists() && is_splat_name(&path));
}
