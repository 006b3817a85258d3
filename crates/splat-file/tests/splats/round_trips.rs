//! Round trips through every format, and how a file's format is recognized.

use super::common::{
    ENDINGS, assert_says, assert_within, bases, bytes_of, largest_error, matched, max_errors, random_splat,
    read_bytes, round_trip, symmetric, written,
};
use glam::DVec3;
use globalsplat_splat_file::{
    Splat, WriteOptions, check_writable_splat, find_splat, is_splat_name, origin_file, output_format,
    read_splat, write_local_splat, write_splat,
};
use rand::SeedableRng;
use rand::rngs::StdRng;
use std::path::Path;

#[test]
fn written_splats_are_read_within_half_a_step() {
    for degree in 0..4 {
        for count in [1, 256, 257, 600] {
            let splat = random_splat(count, degree, degree as u64);
            for ending in ENDINGS {
                let copy = round_trip(ending, &splat);
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
    let mut splat = random_splat(300, 2, 8);
    splat.log_scales[0] = [-100., 80.5, 0.];
    splat.opacity_logits[..3].copy_from_slice(&[-60., 40., 1e-30]);
    assert_eq!(round_trip("ply", &splat), splat);
    assert_eq!(splat.ply_bytes(), bytes_of("ply", &splat).len() as u64);
}

/// Formats that have a place for it say whether a splat is antialiased.
#[test]
fn antialiased_splats_are_marked() {
    for antialiased in [false, true] {
        let splat = Splat { antialiased, ..random_splat(20, 1, 5) };
        for ending in ENDINGS {
            let copy = round_trip(ending, &splat);
            let has_place = !["splat", "glb", "gltf"].contains(&ending);
            let format = output_format(Path::new(&format!("a.{ending}"))).unwrap();
            assert_eq!(format.marks_antialiased, has_place, "{ending}");
            assert_eq!(copy.antialiased, antialiased && has_place, "{ending}");
            assert_eq!(copy.select(&[3]).antialiased, copy.antialiased);
        }
    }
    // splat-transform and PlayCanvas' engine read different marks of a SOG.
    let folder = tempfile::tempdir().unwrap();
    let splat = Splat { antialiased: true, ..random_splat(20, 0, 5) };
    let meta = written(folder.path(), "meta.json", &splat);
    let text = std::fs::read_to_string(&meta).unwrap();
    let marks = ["\"antialias\":true,", "\"model\":\"antialiased\","];
    for (removed, antialiased) in [(&marks[..1], true), (&marks[1..], true), (&marks, false)] {
        assert!(removed.iter().all(|mark| text.contains(mark)), "{text}");
        std::fs::write(&meta, removed.iter().fold(text.clone(), |text, mark| text.replace(mark, "")))
            .unwrap();
        assert_eq!(read_splat(&meta).unwrap().antialiased, antialiased, "without {removed:?}");
    }
    let plain = bytes_of("ply", &random_splat(1, 0, 5));
    let (first, rest) = plain.split_at("ply\nformat binary_little_endian 1.0\n".len());
    for (comment, antialiased) in [
        ("SplatRenderMode: mip", true),
        ("antialiased 1", true),
        ("SplatRenderMode: default", false),
        ("antialiased 0", false),
        ("splatrendermode: Mip", true),
        // The last one counts.
        ("SplatRenderMode: mip\ncomment antialiased 0", false),
        ("SplatRenderMode: mip\ncomment SplatRenderMode: new", false),
        ("SplatRenderMode: default\ncomment Antialiased 1\ncomment antialiased by a filter", true),
    ] {
        let bytes = [first, format!("comment {comment}\n").as_bytes(), rest].concat();
        assert_eq!(read_bytes("ply", &bytes).unwrap().antialiased, antialiased, "{comment}");
    }
}

/// A SOG of many Gaussians has fewer sets of coefficients than Gaussians. They are near the original ones, are known before the file is
/// written, and are written again as they are.
#[test]
fn coefficients_of_a_sog_are_known_beforehand() {
    let mut splat = random_splat(1200, 2, 3);
    // Coefficients of 50 kinds, with differences within each kind.
    for (k, color) in splat.sh.iter_mut().enumerate().filter(|(k, _)| k % 9 > 0) {
        let (index, basis) = (k / 9, k % 9);
        let value =
            |channel| ((index % 50 * (basis + channel)) as f32 / 7.).sin() + (index as f32).sin() / 50.;
        *color = [0, 1, 2].map(value);
    }
    let rounding = |name: &str| output_format(Path::new(name)).unwrap().round_sh;
    let rounded = rounding("a.sog").unwrap()(&splat);
    let error = largest_error(rounded.sh.as_flattened(), splat.sh.as_flattened());
    assert!(error > 0.001 && error < 0.06, "{error}");
    assert_eq!(Splat { sh: splat.sh.clone(), ..rounded.clone() }, splat);
    for splat in [&splat, &rounded] {
        let copy = matched(splat, &round_trip("sog", splat));
        assert_eq!(bases(&copy, 1, 9), bases(&rounded, 1, 9));
    }
    assert!(rounding("meta.json").is_some() && rounding("a.ply").is_none());
}

/// A quantizing format doesn't change values that it has already rounded. Formats whose steps depend on the bounds of the values, which the
/// file holds in float32 or as logarithms, do so in the last place.
#[test]
fn second_round_trips_change_nothing() {
    for ending in ["ply", "spz", "splat", "glb"] {
        let mut bytes = bytes_of(ending, &random_splat(600, 3, 6));
        for trip in 1..4 {
            let next = bytes_of(ending, &read_bytes(ending, &bytes).unwrap());
            // The first trip normalizes rotations that a .splat has rounded to bytes.
            assert!(bytes == next || (trip == 1 && ending == "splat"), "{ending}, trip {trip}");
            bytes = next;
        }
    }
}

/// A `.splat` keeps the bits of its linear scales, which float32 logarithms couldn't, also when Gaussians are left out.
#[test]
fn linear_scales_are_exact() {
    let mut splat = random_splat(500, 0, 9);
    let random = &mut StdRng::seed_from_u64(4);
    let scale = |_| symmetric(random).map(|number| (8. * number).exp());
    let scales: Vec<[f32; 3]> = (0..500).map(scale).collect();
    splat.log_scales = scales.iter().map(|scale| scale.map(f32::ln)).collect();
    splat.linear_scales = Some(scales);
    splat.quaternions[7] = [0.; 4];
    let drawable = splat.clone().without_missing_rotations("the splat");
    let expected = &drawable.linear_scales;
    let copy = matched(&drawable, &round_trip("splat", &splat));
    assert_eq!(&copy.linear_scales, expected);
    assert_eq!(&matched(&copy, &round_trip("splat", &copy)).linear_scales, expected);
    for (index, log_scale) in copy.log_scales.iter().enumerate() {
        assert_eq!(log_scale[2], f64::from(copy.scale(index)[2]).ln() as f32);
    }
    // A PLY has logarithms alone.
    assert_eq!(round_trip("ply", &copy).linear_scales, None);
}

/// Lengths of quaternions are ignored, in every format: rotations are read back with length 1.
#[test]
fn quaternions_of_any_length_are_kept() {
    let splat = random_splat(257, 0, 12);
    for length in [1e-36f32, 1e-20, 1e-4, 1e4, 1e20, 2e38] {
        let mut other = splat.clone();
        other.quaternions.as_flattened_mut().iter_mut().for_each(|part| *part *= length);
        for ending in ENDINGS {
            let copy = round_trip(ending, &other);
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
    for ending in ["ply", "compressed.ply", "sog", "spz", "glb"] {
        let bytes = bytes_of(ending, &splat);
        written(folder.path(), &format!("a.{ending}"), &splat);
        for other in ENDINGS {
            assert_eq!(read_bytes(other, &bytes).unwrap().len(), 300, "{ending} as {other}");
        }
    }
    assert_eq!(find_splat(folder.path(), "a"), folder.path().join("a.compressed.ply"));
    assert_eq!(find_splat(folder.path(), "b"), folder.path().join("b.ply"));
}

/// Every function that writes refuses a name that stands for no format that is written.
#[test]
fn names_without_a_format_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let splat = random_splat(3, 0, 1);
    let written = "expected .ply, .compressed.ply, .sog, .spz, .splat, .glb, .gltf";
    let read = format!("{written}, .ksplat, meta.json or .zip");
    for (name, message, formats) in [
        ("a.obj", "the ending is .obj", &*read),
        ("a", "the ending is missing", &read),
        ("a.ksplat", "the format is .ksplat, which is only read", written),
        ("a.zip", "the format is .zip, which is only read", written),
    ] {
        let path = folder.path().join(name);
        for error in [
            write_splat(&path, &splat).unwrap_err(),
            check_writable_splat(&path).unwrap_err(),
            output_format(&path).err().unwrap(),
        ] {
            assert!(error.is_invalid_request());
            assert_says(&error.to_string(), &[message, formats]);
        }
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    for name in ["A.Compressed.PLY", "a.spz", "a.ksplat"] {
        assert!(is_splat_name(Path::new(name)), "{name}");
    }
    assert!(!is_splat_name(Path::new("a.obj")));
}

/// The origin keeps the precision of positions far from zero, and a splat in world coordinates has none.
#[test]
fn origins_are_stored_beside_the_splat() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let origin = DVec3::new(448_265.12, 5_411_920.65, 135.4);
    let splat = Splat { origin, ..random_splat(5, 1, 3) };
    write_local_splat(&path, &splat, &WriteOptions::default()).unwrap();
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
    let mut splat = random_splat(3, 0, 1);
    splat.opacity_logits.pop();
    let error = write_splat(Path::new("none.ply"), &splat).unwrap_err();
    assert_says(&error.to_string(), &["the length of opacity_logits is 2, expected 3"]);
    splat.sh_degree = 4;
    assert_says(&splat.check_lengths().unwrap_err().to_string(), &["the SH degree is 4, expected 0 to 3"]);
}

/// Coefficients within a format's limits are stored without being clamped.
#[test]
fn coefficients_within_the_limits_are_kept() {
    for ending in ENDINGS {
        let limits = (output_format(Path::new(&format!("a.{ending}"))).unwrap().limits)();
        let mut splat = random_splat(1, limits.degree, 1);
        for (basis, color) in splat.sh.iter_mut().enumerate() {
            let (low, high) = limits.range_of(basis);
            *color = [low.max(-5.) as f32, high.min(5.) as f32, 0.];
        }
        let error = largest_error(splat.sh.as_flattened(), round_trip(ending, &splat).sh.as_flattened());
        assert!(error < 0.02, "{ending}: {error}");
    }
}
