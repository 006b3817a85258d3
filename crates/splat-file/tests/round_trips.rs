//! Round trips through every format, and how a file's format is recognized.

mod common;

use common::{assert_says, endings, largest_error, random_splat, written};
use glam::DVec3;
use globalsplat_splat_file::{
    SH_C0, Splat, can_mark_antialiased, check_writable_splat, find_splat, has_sh_palette, is_splat_name,
    limits_of, origin_file, read_splat, round_sh, write_local_splat, write_splat,
};
use std::path::Path;

/// Returns the difference between rotations, from quaternions of any length; q and −q are the same rotation.
fn rotation_error(a: &Splat, b: &Splat) -> f64 {
    let unit = |quaternion: &[f32; 4]| {
        let length = quaternion.iter().map(|&part| f64::from(part).powi(2)).sum::<f64>().sqrt();
        quaternion.map(|part| f64::from(part) / length)
    };
    let errors = a.quaternions.iter().zip(&b.quaternions).map(|(a, b)| {
        let (a, b) = (unit(a), unit(b));
        let sign = a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>().signum();
        a.iter().zip(b).map(|(a, b)| (a - sign * b).abs()).fold(0., f64::max)
    });
    errors.fold(0., f64::max)
}

/// Reorders the Gaussians of `to` to match `from`, each to its nearest.
fn matched(from: &Splat, to: &Splat) -> Splat {
    let distance =
        |a: &[f32; 3], b: &[f32; 3]| -> f32 { a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum() };
    let nearest: Vec<usize> = from
        .means
        .iter()
        .map(|mean| {
            let nearer = |a: &usize, b: &usize| {
                distance(mean, &to.means[*a]).total_cmp(&distance(mean, &to.means[*b]))
            };
            (0..to.len()).min_by(nearer).expect("a Gaussian")
        })
        .collect();
    let mut distinct = nearest.clone();
    distinct.sort_unstable();
    distinct.dedup();
    assert_eq!(distinct.len(), nearest.len(), "each to another");
    to.select(&nearest)
}

/// Returns the coefficients of the bases from `from` up to `to`.
fn bases(splat: &Splat, from: usize, to: usize) -> Vec<f32> {
    let range = from.min(splat.bases())..to.min(splat.bases());
    (0..splat.len()).flat_map(|index| splat.sh_of(index)[range.clone()].as_flattened()).copied().collect()
}

/// Checks that the quantization errors are at most those of [`max_errors`].
fn assert_within(what: &str, original: &Splat, copy: &Splat, max_errors: [f64; 7]) {
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
fn max_errors(ending: &str) -> [f64; 7] {
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

#[test]
fn written_splats_are_read_within_half_a_step() {
    let folder = tempfile::tempdir().unwrap();
    for (seed, degree) in (0..4).enumerate() {
        for count in [1, 256, 257, 600] {
            let splat = random_splat(count, degree, seed as u64);
            for ending in endings() {
                let path = written(folder.path(), &format!("splat.{ending}"), &splat);
                let copy = read_splat(&path).unwrap();
                let expected = if ending == "splat" { 0 } else { degree };
                assert_eq!((copy.len(), copy.sh_degree), (count, expected), "{ending}");
                let what = format!("{ending} of {count} Gaussians of degree {degree}");
                assert_within(&what, &splat.with_sh_degree(expected), &copy, max_errors(ending));
            }
        }
    }
}

/// A PLY keeps every number to the bit, and its size is known before it is written.
#[test]
fn plys_are_exact() {
    let folder = tempfile::tempdir().unwrap();
    let mut splat = random_splat(300, 2, 8);
    splat.log_scales[0] = [-100., 80.5, 0.];
    splat.opacity_logits[..3].copy_from_slice(&[-60., 40., 1e-30]);
    let first = written(folder.path(), "a.ply", &splat);
    let copy = read_splat(&first).unwrap();
    assert_eq!(copy, splat);
    let second = written(folder.path(), "b.ply", &copy);
    assert_eq!(std::fs::read(&first).unwrap(), std::fs::read(&second).unwrap());
    assert_eq!(splat.ply_bytes(), std::fs::metadata(&first).unwrap().len());
}

/// Formats that have a place for it say whether a splat is antialiased.
#[test]
fn antialiased_splats_are_marked() {
    let folder = tempfile::tempdir().unwrap();
    for antialiased in [false, true] {
        let splat = Splat { antialiased, ..random_splat(20, 1, 5) };
        for ending in endings() {
            let path = written(folder.path(), &format!("a.{ending}"), &splat);
            let copy = read_splat(&path).unwrap();
            let has_place = !["splat", "glb", "gltf"].contains(&ending);
            assert_eq!(can_mark_antialiased(&path).unwrap(), has_place, "{ending}");
            assert_eq!(copy.antialiased, antialiased && has_place, "{ending}");
            assert_eq!(copy.select(&[3]).antialiased, copy.antialiased);
        }
    }
    let ply =
        std::fs::read(written(folder.path(), "a.ply", &Splat { antialiased: true, ..random_splat(1, 0, 5) }))
            .unwrap();
    let text = String::from_utf8_lossy(&ply);
    assert!(
        text.starts_with("ply\nformat binary_little_endian 1.0\ncomment SplatRenderMode: mip\n"),
        "{text}"
    );
    for (comment, expected) in
        [("antialiased 1", true), ("SplatRenderMode: default", false), ("antialiased 0", false)]
    {
        let path = folder.path().join("other.ply");
        let other = text.find("comment ").unwrap();
        let mut bytes = ply[..other].to_vec();
        bytes.extend(format!("comment {comment}\n").bytes());
        bytes.extend(&ply[other + "comment SplatRenderMode: mip\n".len()..]);
        std::fs::write(&path, bytes).unwrap();
        assert_eq!(read_splat(&path).unwrap().antialiased, expected, "{comment}");
    }
}

/// A SOG of many Gaussians has fewer sets of coefficients than Gaussians. They are near the original ones, are known before the file is
/// written, and are written again as they are.
#[test]
fn coefficients_of_a_sog_are_known_beforehand() {
    let folder = tempfile::tempdir().unwrap();
    let mut splat = random_splat(1200, 2, 3);
    // Coefficients of 50 kinds, with differences within each kind.
    for index in 0..splat.len() {
        for basis in 1..9 {
            splat.sh[index * 9 + basis] = [0, 1, 2].map(|channel| {
                ((index % 50 * (basis + channel)) as f32 / 7.).sin() + (index as f32).sin() / 50.
            });
        }
    }
    let path = folder.path().join("a.sog");
    let rounded = round_sh(&path, &splat).unwrap();
    let error = largest_error(rounded.sh.as_flattened(), splat.sh.as_flattened());
    assert!(error > 0.001 && error < 0.06, "{error}");
    assert_eq!(Splat { sh: splat.sh.clone(), ..rounded.clone() }, splat);
    for (name, expected) in [("a.sog", &splat), ("b.sog", &rounded), ("meta.json", &rounded)] {
        let copy = matched(expected, &read_splat(&written(folder.path(), name, expected)).unwrap());
        assert_eq!(bases(&copy, 1, 9), bases(&rounded, 1, 9), "{name}");
    }
    let ply = folder.path().join("a.ply");
    assert_eq!(round_sh(&ply, &splat).unwrap(), splat);
    assert_eq!((has_sh_palette(&path).unwrap(), has_sh_palette(&ply).unwrap()), (true, false));
}

/// A quantizing format doesn't change values that it has already rounded. Formats whose steps depend on the bounds of the values, which the
/// file holds in float32 or as logarithms, do so in the last place.
#[test]
fn second_round_trips_change_nothing() {
    let folder = tempfile::tempdir().unwrap();
    for ending in endings().filter(|ending| !["compressed.ply", "sog"].contains(ending)) {
        let mut path = written(folder.path(), &format!("0.{ending}"), &random_splat(600, 3, 6));
        for trip in 1..4 {
            let next = written(folder.path(), &format!("{trip}.{ending}"), &read_splat(&path).unwrap());
            // The JSON of a .gltf names its buffer, which has the numbers.
            let [a, b] = [&path, &next].map(|path| match ending {
                "gltf" => std::fs::read(path.with_extension("bin")).unwrap(),
                _ => std::fs::read(path).unwrap(),
            });
            // The first trip normalizes rotations that a .splat has rounded to bytes.
            assert!(a == b || (trip == 1 && ending == "splat"), "{ending}, trip {trip}");
            path = next;
        }
    }
}

/// A `.splat` keeps the bits of its linear scales, which float32 logarithms couldn't, also when Gaussians are left out.
#[test]
fn linear_scales_are_exact() {
    let folder = tempfile::tempdir().unwrap();
    let mut splat = random_splat(500, 0, 9);
    let mut random = common::Random::new(4);
    let scales: Vec<[f32; 3]> =
        (0..500).map(|_| random.symmetric().map(|number: f32| (8. * number).exp())).collect();
    splat.log_scales = scales.iter().map(|scale| scale.map(f32::ln)).collect();
    splat.linear_scales = Some(scales.clone());
    splat.quaternions[7] = [0.; 4];
    let path = written(folder.path(), "a.splat", &splat);
    let copy = read_splat(&path).unwrap();
    let sorted = |scales: &[[f32; 3]]| {
        let mut bits: Vec<_> = scales.iter().map(|scale| scale.map(f32::to_bits)).collect();
        bits.sort_unstable();
        bits
    };
    let expected = sorted(&[&scales[..7], &scales[8..]].concat());
    assert_eq!(sorted(copy.linear_scales.as_ref().unwrap()), expected);
    let again = read_splat(&written(folder.path(), "b.splat", &copy)).unwrap();
    assert_eq!(sorted(&again.linear_scales.unwrap()), expected);
    for (index, log_scale) in copy.log_scales.iter().enumerate() {
        assert_eq!(log_scale[2], f64::from(copy.scale(index)[2]).ln() as f32);
    }
    // A PLY has logarithms alone.
    assert_eq!(read_splat(&written(folder.path(), "a.ply", &copy)).unwrap().linear_scales, None);
}

/// Lengths of quaternions are ignored, in every format: rotations are read back with length 1.
#[test]
fn quaternions_of_any_length_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let splat = random_splat(257, 0, 12);
    for length in [1e-36f32, 1e-20, 1e-4, 1e4, 1e20, 2e38] {
        let mut other = splat.clone();
        other.quaternions.as_flattened_mut().iter_mut().for_each(|part| *part *= length);
        for ending in endings() {
            let copy = read_splat(&written(folder.path(), &format!("a.{ending}"), &other)).unwrap();
            assert_eq!((copy.len(), copy.warnings.len()), (257, 0), "{ending}, length {length:e}");
            let mut max_errors = max_errors(ending);
            max_errors[2] += 1e-6;
            let what = format!("{ending} with quaternions of length {length:e}");
            assert_within(&what, &splat, &copy, max_errors);
        }
    }
}

/// A new splat of several files doesn't replace a file that was there before.
#[test]
fn files_beside_a_new_splat_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let (splat, path) = (random_splat(3, 0, 1), folder.path().join("a.gltf"));
    check_writable_splat(&path).unwrap();
    std::fs::write(folder.path().join("a.bin"), "mine").unwrap();
    let error = check_writable_splat(&path).unwrap_err().to_string();
    assert_says(&error, &["a.gltf: a file beside it is ", "a.bin, which would be replaced"]);
    write_splat(&path, &splat).unwrap();
    check_writable_splat(&path).unwrap();
}

/// The contents of a file determine its format, not its name, for formats that can be recognized.
#[test]
fn files_are_recognized() {
    let folder = tempfile::tempdir().unwrap();
    let splat = random_splat(300, 2, 2);
    for ending in endings().filter(|ending| !["splat", "gltf"].contains(ending)) {
        let path = written(folder.path(), &format!("a.{ending}"), &splat);
        for other in endings() {
            let renamed = folder.path().join(format!("renamed.{other}"));
            std::fs::copy(&path, &renamed).unwrap();
            assert_eq!(read_splat(&renamed).unwrap().len(), 300, "{ending} as {other}");
        }
    }
    assert_eq!(find_splat(folder.path(), "a"), folder.path().join("a.compressed.ply"));
    assert_eq!(find_splat(folder.path(), "b"), folder.path().join("b.ply"));
    assert!(is_splat_name(Path::new("A.Compressed.PLY")) && is_splat_name(Path::new("a.spz")));
    assert!(!is_splat_name(Path::new("a.obj")));
    for (name, message) in [("a.obj", "the ending is .obj"), ("a", "the ending is missing")] {
        let error = write_splat(&folder.path().join(name), &splat).unwrap_err();
        assert!(error.is_invalid_request());
        assert_says(
            &error.to_string(),
            &[
                message,
                "expected .ply, .compressed.ply, .sog, .spz, .splat, .glb, .gltf, .ksplat or meta.json",
            ],
        );
    }
}

/// The origin keeps the precision of positions far from zero, and a splat in world coordinates has none.
#[test]
fn origins_are_stored_beside_the_splat() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let origin = DVec3::new(448_265.12, 5_411_920.65, 135.4);
    let splat = Splat { origin, ..random_splat(5, 1, 3) };
    write_local_splat(&path, &splat).unwrap();
    assert_eq!(read_splat(&path).unwrap(), splat);
    let moved = splat.with_origin(origin + DVec3::new(1., -2., 4.));
    assert!((moved.means[0][0] - (splat.means[0][0] - 1.)).abs() < 1e-6);
    write_splat(&path, &splat).unwrap();
    assert!(!origin_file(&path).exists());
    let world = read_splat(&path).unwrap();
    assert_eq!(world.origin, DVec3::ZERO);
    assert!((f64::from(world.means[0][1]) - (origin.y + f64::from(splat.means[0][1]))).abs() <= 0.25);
}

/// Spherical harmonics of a higher degree are 0, and a lower degree drops them.
#[test]
fn degrees_are_changed() {
    let splat = random_splat(4, 1, 2);
    let higher = splat.with_sh_degree(3);
    assert_eq!((higher.sh.len(), higher.sh_degree), (4 * 16, 3));
    assert_eq!(higher.sh_of(3)[..4], *splat.sh_of(3));
    assert!(higher.sh_of(3)[4..].iter().all(|color| *color == [0.; 3]));
    assert_eq!(higher.with_sh_degree(1), splat);
    assert_eq!(splat.with_sh_degree(0).sh_of(2), &splat.sh_of(2)[..1]);
}

/// A splat whose lists don't fit together can't be created, and one that was changed to be so isn't written.
#[test]
fn lengths_are_checked() {
    let error = Splat::new(1, vec![[0.; 3]], vec![[0.; 3]], vec![[1.; 4]], vec![0.], vec![[0.; 3]]);
    assert_says(&error.unwrap_err().to_string(), &["the length of sh is 1, expected 4 for 1 Gaussians"]);
    let error = Splat::new(4, vec![], vec![], vec![], vec![], vec![]).unwrap_err();
    assert_says(&error.to_string(), &["the SH degree is 4, expected 0 to 3"]);
    let folder = tempfile::tempdir().unwrap();
    let mut splat = random_splat(3, 0, 1);
    splat.opacity_logits.pop();
    let error = write_splat(&folder.path().join("a.ply"), &splat).unwrap_err();
    assert_says(&error.to_string(), &["the length of opacity_logits is 2, expected 3"]);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// Coefficients within a format's limits are stored without being clamped.
#[test]
fn coefficients_within_the_limits_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    for ending in endings() {
        let path = folder.path().join(format!("a.{ending}"));
        let limits = limits_of(&path).unwrap();
        let mut splat = random_splat(1, limits.degree, 1);
        for (basis, color) in splat.sh.iter_mut().enumerate() {
            let (low, high) = limits.range_of(basis);
            *color = [low.max(-5.) as f32, high.min(5.) as f32, 0.];
        }
        write_splat(&path, &splat).unwrap();
        let copy = read_splat(&path).unwrap();
        let error = largest_error(splat.sh.as_flattened(), copy.sh.as_flattened());
        assert!(error < 0.02, "{ending}: {error}");
    }
}
