//! mkkellogg's .ksplat: values of every compression level, and invalid files. This project doesn't write the format: `files/` has a file of
//! each level, built by the format's description, of three sections of SH degrees 1, 3 and 0 with full and partial buckets, and one with
//! a range of coefficients, each beside a PLY of the same Gaussians.

use super::common::{assert_changes_refused, largest_error, read_bytes, refusal};
use globalsplat_splat_file::read_splat;
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
    let cases: [(usize, &[u8], &str); 13] = [
        (0, &[1], "the version is 1.1, expected 0.1"),
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
    ];
    assert_changes_refused("ksplat", &whole, &cases);
    for length in (0..whole.len()).step_by(97) {
        refusal(read_bytes("ksplat", &whole[..length]));
    }
}
