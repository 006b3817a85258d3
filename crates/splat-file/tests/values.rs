//! Values that the properties and bytes of files stand for.

mod common;

use common::{
    assert_says, body_of_ply, largest_error, random_splat, refused_file, small_gaussians, write_ply,
    write_surfels, written,
};
use globalsplat_splat_file::{MIN_SCALE, OPACITY_MARGIN, SH_C0, read_splat};

/// A PLY is read identically as text, in both byte orders, and with all other elements that it may contain.
#[test]
fn a_ply_is_read_however_it_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let splat = random_splat(3, 1, 5);
    let plain = std::fs::read(written(folder.path(), "plain.ply", &splat)).unwrap();
    let end = body_of_ply(&plain);
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
        let original = read_splat(&folder.path().join("plain.ply")).unwrap();
        assert_eq!(read_splat(&path).unwrap(), original, "{encoding}");
    }
}

/// Opacities of exactly 1 and 0 have infinite logits, and scales of 0 an infinite logarithm, in files of programs that store bytes. They
/// are kept in memory, and written as finite numbers.
#[test]
fn infinite_logits_are_opacities_of_0_and_1() {
    let folder = tempfile::tempdir().unwrap();
    let path = written(folder.path(), "a.ply", &random_splat(1, 0, 3));
    let mut bytes = std::fs::read(&path).unwrap();
    let body = bytes.len() - 17 * 4;
    let set = |bytes: &mut Vec<u8>, column: usize, number: f32| {
        bytes[body + 4 * column..][..4].copy_from_slice(&number.to_le_bytes());
    };
    for (logit, opacity) in [(f32::INFINITY, 1.), (f32::NEG_INFINITY, 0.)] {
        set(&mut bytes, 9, logit);
        set(&mut bytes, 10, f32::NEG_INFINITY);
        std::fs::write(&path, &bytes).unwrap();
        let splat = read_splat(&path).unwrap();
        assert_eq!((splat.opacity_logits[0], splat.log_scales[0][0]), (logit, f32::NEG_INFINITY));
        assert_eq!((splat.opacity(0), splat.scale(0)[0]), (opacity, 0.));
        let copy = read_splat(&written(folder.path(), "b.ply", &splat)).unwrap();
        assert!((f64::from(copy.opacity(0) - opacity).abs() - OPACITY_MARGIN).abs() < 1e-7);
        assert_eq!(copy.log_scales[0][0], MIN_SCALE.ln() as f32);
        let copy = read_splat(&written(folder.path(), "b.splat", &splat)).unwrap();
        assert_eq!((copy.opacity_logits[0], copy.log_scales[0][0]), (logit, f32::NEG_INFINITY));
    }
    set(&mut bytes, 10, 89.);
    std::fs::write(&path, &bytes).unwrap();
    assert_says(&refused_file(&path), &["scale_0 of vertex 0 is 89", "at most 88"]);
}

/// Linear scales and opacities are those of the logarithms and logits, rounded once.
#[test]
fn scales_and_opacities_are_rounded_once() {
    let splat = random_splat(100, 0, 5);
    for index in 0..splat.len() {
        let scale = f64::from(splat.log_scales[index][1]).exp();
        assert_eq!(splat.scale(index)[1], scale as f32);
        let logit = f64::from(splat.opacity_logits[index]);
        assert!((f64::from(splat.opacity(index)) - logit.exp() / (1. + logit.exp())).abs() < 3e-8);
    }
    let folder = tempfile::tempdir().unwrap();
    let bytes = std::fs::read(written(folder.path(), "a.splat", &splat)).unwrap();
    let importance = |index: &usize| {
        splat.scale(*index).iter().map(|&s| f64::from(s)).product::<f64>() * f64::from(splat.opacity(*index))
    };
    let first = (0..100).max_by(|a, b| importance(a).total_cmp(&importance(b))).unwrap();
    assert_eq!(bytes[12..16], splat.scale(first)[0].to_le_bytes());
}

/// Bytes are the colors themselves in older files, without bounds of colors.
#[test]
fn older_compressed_plys_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = written(folder.path(), "a.compressed.ply", &random_splat(2, 0, 4));
    let bytes = std::fs::read(&path).unwrap();
    let body = body_of_ply(&bytes);
    let header = String::from_utf8(bytes[..body].to_vec()).unwrap();
    let colors = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"];
    let header =
        colors.iter().fold(header, |header, name| header.replace(&format!("property float {name}\n"), ""));
    let vertices = &bytes[body + 18 * 4..];
    std::fs::write(&path, [header.as_bytes(), &bytes[body..][..12 * 4], vertices].concat()).unwrap();
    let read = read_splat(&path).unwrap();
    let red = f64::from(vertices[15]) / 255.; // the highest byte of the fourth word
    assert!(((red - 0.5) / SH_C0 - f64::from(read.sh[0][0])).abs() < 1e-6);
}

/// 2DGS has no third scale: its Gaussians are flat, with the smallest scale.
#[test]
fn surfels_are_flat() {
    let folder = tempfile::tempdir().unwrap();
    let surfels = write_surfels(folder.path());
    let splat = read_splat(&surfels).unwrap();
    assert_says(&splat.warnings[0], &["surfels.ply: Gaussians are flat", "scale_2"]);
    assert_eq!(splat.log_scales, [[-1.5, -2., MIN_SCALE.ln() as f32]; 3]);
    assert!(splat.scale(0)[2] > 0.);
}

/// Colors instead of spherical harmonics are read, whatever their type and their names.
#[test]
fn colors_are_harmonics_of_degree_0() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("colors.ply");
    let bytes = [[0., 255., 10.], [128., 3., 20.], [255., 77., 30.]];
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
            let expected: Vec<f32> = (0..3)
                .flat_map(|row| bytes.map(|of_rows| ((of_rows[row] / 255. - 0.5) / SH_C0) as f32))
                .collect();
            let step = if of == "ushort" { 1e-4 } else { 1e-6 };
            let error = largest_error(splat.sh.as_flattened(), &expected);
            assert!(error < step, "{of} {names:?} of {whole}: {error}");
            // If there are coefficients as well, another program derived the colors from them, and they are ignored.
            columns.extend(small_gaussians().into_iter().filter(|(name, _)| name.starts_with("f_dc")));
            write_ply(&path, &columns, &names.map(|name| (name, of)));
            let splat = read_splat(&path).unwrap();
            assert!(splat.warnings.is_empty() && splat.sh[0][0] == 1.);
        }
    }
}
