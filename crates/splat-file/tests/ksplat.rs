//! mkkellogg's .ksplat: values of every compression level, and invalid files. No program of ours writes them, so they are built here.

mod common;

use common::{Random, assert_says, largest_error, refused_file, written};
use globalsplat_splat_file::{
    SH_C0, check_writable_splat, is_splat_name, limits_of, read_splat, read_splat_without_invalid,
    write_splat,
};
use std::path::{Path, PathBuf};

/// Number of Gaussians of each section: two full buckets of four, and partially filled ones of two and one.
const COUNT: usize = 11;
const PARTIAL: [u32; 2] = [2, 1];
const CENTRES: [[f32; 3]; 4] = [[1., 2., 3.], [-4., 5., 0.5], [6., -7., 8.], [0., 0.25, -9.]];
const BLOCK: f32 = 5.;

/// Values of a Gaussian as the file stores them: numbers of 16 bits and bytes that are exact in every level.
#[derive(Clone)]
struct Stored {
    position: [u16; 3],
    scale: [f32; 3],
    rotation: [f32; 4],
    colour: [u8; 4],
    /// Bytes of the spherical harmonics, basis by basis.
    sh: Vec<[u8; 3]>,
}

impl Stored {
    fn random(random: &mut Random, degree: usize) -> Self {
        let byte = |random: &mut Random| (random.uniform() * 256.) as u8;
        let eighths = |number: f32| (number * 64.).round() / 64.;
        Stored {
            position: [(); 3].map(|()| (random.uniform() * 65535.) as u16),
            scale: random.symmetric().map(|number: f32| eighths(number.abs() + 0.1)),
            rotation: random.symmetric().map(eighths),
            colour: [(); 4].map(|()| byte(random)),
            sh: (1..(degree + 1).pow(2)).map(|_| [(); 3].map(|()| byte(random))).collect(),
        }
    }

    /// Returns the position in bucket `bucket`.
    fn position(&self, bucket: usize, range: u32) -> [f32; 3] {
        std::array::from_fn(|axis| {
            let step = f64::from(self.position[axis]) - f64::from(range);
            (f64::from(CENTRES[bucket][axis]) + step / f64::from(range) * f64::from(BLOCK) / 2.) as f32
        })
    }
}

/// Returns the coefficient that a byte stands for in a range.
fn from_byte(byte: u8, [min, max]: [f32; 2]) -> f32 {
    min + f32::from(byte) / 255. * (max - min)
}

/// Returns the half-precision number `value`, which must be normal and exact, or 0.
fn half(value: f32) -> [u8; 2] {
    let bits = value.to_bits();
    let sign = (bits >> 16 & 0x8000) as u16;
    let exponent = (bits >> 23 & 0xff) as u16;
    let rest = (bits >> 13 & 0x3ff) as u16;
    (if value == 0. { sign } else { sign | (exponent - 112) << 10 | rest }).to_le_bytes()
}

/// File to be built.
#[derive(Clone)]
struct File {
    level: u16,
    /// Minimum and maximum of the spherical harmonics, where 0 means ±1.5.
    sh_range: [f32; 2],
    /// Quantization range of positions, where 0 means 32,767.
    range: u32,
    /// Degree and Gaussians of each section.
    sections: Vec<(usize, Vec<Stored>)>,
}

impl File {
    fn random(level: u16, degrees: &[usize]) -> Self {
        let mut random = Random::new(u64::from(level) + 10);
        let sections = degrees
            .iter()
            .map(|&degree| (degree, (0..COUNT).map(|_| Stored::random(&mut random, degree)).collect()));
        File { level, sh_range: [0.; 2], range: 0, sections: sections.collect() }
    }

    fn sh_range(&self) -> [f32; 2] {
        if self.sh_range == [0.; 2] { [-1.5, 1.5] } else { self.sh_range }
    }

    /// Returns the bucket of Gaussian `index`.
    fn bucket(index: usize) -> usize {
        [0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 3][index]
    }

    fn range(&self) -> u32 {
        if self.range == 0 { 32767 } else { self.range }
    }

    fn bytes(&self) -> Vec<u8> {
        let mut bytes = vec![0; 4096 + 1024 * self.sections.len()];
        let put = |bytes: &mut Vec<u8>, at: usize, number: &[u8]| {
            bytes[at..at + number.len()].copy_from_slice(number);
        };
        let count = self.sections.len() as u32;
        bytes[1] = 1;
        for (at, number) in [(4, count), (8, count), (12, COUNT as u32 * count), (16, COUNT as u32 * count)] {
            put(&mut bytes, at, &number.to_le_bytes());
        }
        put(&mut bytes, 20, &self.level.to_le_bytes());
        put(&mut bytes, 36, &self.sh_range[0].to_le_bytes());
        put(&mut bytes, 40, &self.sh_range[1].to_le_bytes());
        let has_buckets = self.level > 0;
        for (index, (degree, gaussians)) in self.sections.iter().enumerate() {
            let base = 4096 + 1024 * index;
            put(&mut bytes, base, &(COUNT as u32).to_le_bytes());
            put(&mut bytes, base + 4, &(COUNT as u32).to_le_bytes());
            put(&mut bytes, base + 40, &(*degree as u16).to_le_bytes());
            if has_buckets {
                for (at, number) in [(8, 4u32), (12, 4), (24, self.range), (32, 2), (36, 2)] {
                    put(&mut bytes, base + at, &number.to_le_bytes());
                }
                put(&mut bytes, base + 16, &BLOCK.to_le_bytes());
                put(&mut bytes, base + 20, &12u16.to_le_bytes());
                bytes.extend(PARTIAL.iter().flat_map(|length| length.to_le_bytes()));
                bytes.extend(CENTRES.as_flattened().iter().flat_map(|number| number.to_le_bytes()));
            }
            for (place, gaussian) in gaussians.iter().enumerate() {
                let number = |bytes: &mut Vec<u8>, value: f32| match self.level {
                    0 => bytes.extend(value.to_le_bytes()),
                    _ => bytes.extend(half(value)),
                };
                match self.level {
                    0 => bytes.extend(
                        gaussian
                            .position(Self::bucket(place), self.range())
                            .iter()
                            .flat_map(|x| x.to_le_bytes()),
                    ),
                    _ => bytes.extend(gaussian.position.iter().flat_map(|x| x.to_le_bytes())),
                }
                gaussian.scale.iter().chain(&gaussian.rotation).for_each(|&value| number(&mut bytes, value));
                bytes.extend(gaussian.colour);
                let mut from = 0;
                for of_degree in 1..=*degree {
                    let bases = 2 * of_degree + 1;
                    for channel in 0..3 {
                        for sh in &gaussian.sh[from..from + bases] {
                            match self.level {
                                2 => bytes.push(sh[channel]),
                                _ => number(&mut bytes, f32::from(sh[channel]) / 64. - 2.),
                            }
                        }
                    }
                    from += bases;
                }
            }
        }
        bytes
    }

    /// Returns spherical harmonics from degree 1, up to the degree of the section.
    fn harmonics(&self, gaussian: &Stored) -> Vec<[f32; 3]> {
        let number = |byte: u8| match self.level {
            2 => from_byte(byte, self.sh_range()),
            _ => f32::from(byte) / 64. - 2.,
        };
        gaussian.sh.iter().map(|colour| colour.map(number)).collect()
    }

    fn write(&self, folder: &Path) -> PathBuf {
        let path = folder.join("a.ksplat");
        std::fs::write(&path, self.bytes()).unwrap();
        path
    }
}

/// Returns files of every level and SH degree, with all defaults and with a range of coefficients and positions.
fn files() -> Vec<File> {
    let mut files = vec![];
    for level in 0..3 {
        for degrees in [&[0][..], &[1], &[2], &[3], &[1, 2, 0]] {
            files.push(File::random(level, degrees));
        }
        files.push(File { sh_range: [-0.5, 2.25], range: 16384, ..File::random(level, &[2]) });
    }
    files
}

/// Every level and degree is read, with the buckets, the order of the spherical harmonics and the defaults of the format. A section of a
/// lower degree than others is padded with zeros.
#[test]
fn ksplats_are_read() {
    let folder = tempfile::tempdir().unwrap();
    for file in files() {
        let splat = read_splat(&file.write(folder.path())).unwrap();
        let degrees: Vec<usize> = file.sections.iter().map(|(degree, _)| *degree).collect();
        let what = format!("level {}, degrees {degrees:?}", file.level);
        assert_eq!(splat.len(), COUNT * degrees.len(), "{what}");
        assert_eq!(splat.sh_degree, *degrees.iter().max().unwrap(), "{what}");
        assert!(splat.warnings.is_empty() && !splat.antialiased);
        let all = file.sections.iter().flat_map(|(_, gaussians)| gaussians.iter().enumerate());
        for (index, (place, gaussian)) in all.enumerate() {
            let position = gaussian.position(File::bucket(place), file.range());
            assert!(largest_error(&splat.means[index], &position) < 1e-6, "{what}: position {index}");
            assert_eq!(splat.scale(index), gaussian.scale, "{what}");
            assert_eq!(splat.quaternions[index], gaussian.rotation, "{what}");
            assert!((splat.opacity(index) - f32::from(gaussian.colour[3]) / 255.).abs() < 1e-6, "{what}");
            let dc =
                [0, 1, 2].map(|channel| (f32::from(gaussian.colour[channel]) / 255. - 0.5) / SH_C0 as f32);
            let mut sh = vec![dc];
            sh.extend(file.harmonics(gaussian));
            sh.resize(splat.bases(), [0.; 3]);
            let error = largest_error(splat.sh_of(index).as_flattened(), sh.as_flattened());
            assert!(error < 1e-6, "{what}: spherical harmonics of {index} are off by {error}");
        }
        // What is read can be written in another format.
        let copy = read_splat(&written(folder.path(), "a.ply", &splat)).unwrap();
        assert_eq!((copy.len(), &copy.sh), (splat.len(), &splat.sh));
    }
}

#[test]
fn half_precision_numbers_are_exact() {
    let folder = tempfile::tempdir().unwrap();
    let path = File::random(1, &[0]).write(folder.path());
    let bytes = std::fs::read(&path).unwrap();
    let scale = 4096 + 1024 + 8 + 48 + 6;
    for (bits, expected) in
        [(0x0001u16, 2f32.powi(-24)), (0x03ff, 1023. * 2f32.powi(-24)), (0x0400, 2f32.powi(-14))]
            .into_iter()
            .chain([(0, 0.), (0x3c00, 1.), (0x3555, 0.333_251_95), (0x7bff, 65504.)])
    {
        let mut bytes = bytes.clone();
        bytes[scale..scale + 2].copy_from_slice(&bits.to_le_bytes());
        std::fs::write(&path, bytes).unwrap();
        assert_eq!(read_splat(&path).unwrap().scale(0)[0], expected);
    }
    for (bits, found) in [(0x7c00u16, "inf"), (0xfc00, "-inf"), (0x7e00, "NaN"), (0xbc00, "-1")] {
        let mut bytes = bytes.clone();
        bytes[scale..scale + 2].copy_from_slice(&bits.to_le_bytes());
        std::fs::write(&path, bytes).unwrap();
        assert_says(&refused_file(&path), &[&format!("the scale of Gaussian 0 is {found},")]);
        assert_eq!(read_splat_without_invalid(&path).unwrap().len(), COUNT - 1);
    }
}

/// Rotations of NaN are refused, or left out.
#[test]
fn rotations_are_checked() {
    let folder = tempfile::tempdir().unwrap();
    let path = File::random(0, &[0]).write(folder.path());
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[4096 + 1024 + 44 + 24..][..4].copy_from_slice(&f32::NAN.to_le_bytes());
    std::fs::write(&path, bytes).unwrap();
    assert_says(&refused_file(&path), &["the rotation of Gaussian 1 is NaN, expected finite numbers"]);
    assert_eq!(read_splat_without_invalid(&path).unwrap().len(), COUNT - 1);
}

#[test]
fn bad_ksplats() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ksplat");
    let whole = File::random(1, &[2, 1]).bytes();
    let changed = |at: usize, number: &[u8]| {
        let mut bytes = whole.clone();
        bytes[at..at + number.len()].copy_from_slice(number);
        std::fs::write(&path, bytes).unwrap();
        refused_file(&path)
    };
    let all = u32::MAX.to_le_bytes();
    assert_says(&changed(0, &[1]), &["the version is 1.1, expected 0.1"]);
    assert_says(&changed(1, &[0]), &["the version is 0.0"]);
    assert_says(&changed(20, &[3]), &["the compression level is 3, expected 0 to 2"]);
    assert_says(&changed(4, &all), &["the number of sections is 4294967295"]);
    assert_says(&changed(16, &[23]), &["the number of Gaussians is 23, with 22 in the sections"]);
    assert_says(&changed(4096, &[12]), &["the number of Gaussians of section 0 is 12, expected 11 at most"]);
    assert_says(&changed(4096 + 4, &all), &["the body of section 0 is cut short", "309237645296 bytes"]);
    assert_says(&changed(4096 + 12, &all), &["the body of section 0 is cut short"]);
    assert_says(&changed(4096 + 36, &all), &["the body of section 0 is cut short"]);
    assert_says(
        &changed(4096 + 12, &[3]),
        &["the number of buckets of section 0 is 3, expected 2 full and 2"],
    );
    assert_says(&changed(4096 + 32, &all), &["expected 4294967295 full and 2 partially filled ones"]);
    assert_says(&changed(4096 + 20, &[10]), &["the size of a bucket of section 0 is 10, expected 12 bytes"]);
    assert_says(
        &changed(4096 + 8, &[3]),
        &["the number of Gaussians in the buckets of section 0 is 9, expected 11"],
    );
    assert_says(&changed(4096 + 8, &[0]), &["in the buckets of section 0 is 3"]);
    assert_says(&changed(4096 + 1024 + 40, &[4]), &["the SH degree is 4, expected 0 to 3"]);
    let infinite = changed(4096 + 16, &f32::INFINITY.to_le_bytes());
    assert_says(&infinite, &["the position of Gaussian 0 is", "finite numbers"]);
    let mut empty = whole[..4096].to_vec();
    empty[4..20].fill(0);
    std::fs::write(&path, empty).unwrap();
    assert_says(&refused_file(&path), &["the number of Gaussians is 0, with 0 in the sections"]);
    for length in (0..whole.len()).filter(|length| length % 97 == 0 || *length > 4096 + 2000) {
        std::fs::write(&path, &whole[..length]).unwrap();
        refused_file(&path);
    }
}

/// No change of a byte makes the reader panic or allocate what the file can't hold.
#[test]
fn random_changes_are_read_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ksplat");
    let mut random = Random::new(5);
    for file in files() {
        let whole = file.bytes();
        for _ in 0..100 {
            let mut bytes = whole.clone();
            for _ in 0..4 {
                let at = match random.uniform() {
                    part if part < 0.3 => 44. * random.uniform(),
                    part if part < 0.8 => 4096. + 44. * random.uniform(),
                    _ => random.uniform() * (bytes.len() - 1) as f32,
                };
                bytes[at as usize] = (random.uniform() * 256.) as u8;
            }
            std::fs::write(&path, bytes).unwrap();
            if let Err(error) = read_splat(&path) {
                assert_eq!(error.to_string().lines().count(), 1);
                assert!(error.is_invalid_request());
            }
        }
    }
}

/// The format is only read: every function that writes says so before it writes.
#[test]
fn ksplats_are_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ksplat");
    let splat = common::random_splat(3, 0, 1);
    let errors = [
        write_splat(&path, &splat).unwrap_err(),
        check_writable_splat(&path).unwrap_err(),
        limits_of(&path).unwrap_err(),
    ];
    for error in errors {
        assert!(error.is_invalid_request());
        let message =
            "a.ksplat: the format is .ksplat, which is only read, expected .ply, .compressed.ply, .sog, .spz";
        assert_says(&error.to_string(), &[message]);
    }
    assert!(!path.exists() && is_splat_name(&path));
}
