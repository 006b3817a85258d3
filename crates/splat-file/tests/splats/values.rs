//! Values that the properties and bytes of files stand for.

use super::common::{
    assert_refused, assert_says, body_of_ply, bytes_of, largest_error, random_splat, read_bytes, round_trip,
    set, small_gaussians, write_changed_ply, write_ply,
};
use globalsplat_splat_file::{MIN_SCALE, OPACITY_MARGIN, SH_C0, read_splat};

/// A PLY is read identically as text, in both byte orders, and with all other elements that it may contain.
#[test]
fn a_ply_is_read_however_it_is_written() {
    let splat = random_splat(3, 1, 5);
    let plain = bytes_of("ply", &splat);
    let end = body_of_ply(&plain);
    let names: Vec<String> = String::from_utf8_lossy(&plain[..end])
        .lines()
        .filter_map(|line| Some(line.strip_prefix("property float ")?.to_string()))
        .collect();
    let numbers: Vec<f32> = plain[end..].as_chunks().0.iter().map(|&four| f32::from_le_bytes(four)).collect();
    for encoding in ["ascii", "binary_little_endian", "binary_big_endian"] {
        let mut header =
            format!("ply\r\nformat {encoding} 1.0\r\ncomment end_header of element vertex 7\r\n");
        header += "element camera 2\r\nproperty list uchar short matrix\r\nproperty double focal\r\n";
        header += "element vertex 3\r\n";
        for (column, name) in names.iter().enumerate().rev() {
            header += &format!("property double {name}\r\nproperty list int uchar more_{column}\r\n");
        }
        header += "element face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n";
        let mut bytes = header.into_bytes();
        // Appends a double, or an integer of a number of bytes.
        let mut put = |number: f64, integer: Option<usize>| {
            let mut one = integer.map_or(number.to_le_bytes(), |_| (number as i64).to_le_bytes());
            let one = &mut one[..integer.unwrap_or(8)];
            match encoding {
                "ascii" => return bytes.extend(format!("{number}\n ").bytes()),
                "binary_big_endian" => one.reverse(),
                _ => {}
            }
            bytes.extend(&*one);
        };
        for length in [3, 0] {
            put(f64::from(length), Some(1));
            (0..length).for_each(|k| put(f64::from(k - 1), Some(2)));
            put(1.5, None);
        }
        for &number in numbers.chunks(names.len()).flat_map(|row| row.iter().rev()) {
            put(f64::from(number), None);
            [(2., 4), (200., 1), (7., 1)].into_iter().for_each(|(number, size)| put(number, Some(size)));
        }
        put(1., Some(1));
        put(-2., Some(4));
        let read = read_bytes("ply", &bytes).unwrap();
        assert_eq!(read, read_bytes("ply", &plain).unwrap(), "{encoding}");
    }
}

/// CloudCompare saves properties with a prefix, and 3dgsconverter puts another one before it.
#[test]
fn properties_of_cloudcompare_are_read() {
    let plain = bytes_of("ply", &random_splat(3, 1, 5));
    let (header, body) = plain.split_at(body_of_ply(&plain));
    let header = String::from_utf8_lossy(header);
    for prefix in ["scalar_", "scal_", "scalar_scal_"] {
        let mut header = header.to_string();
        for name in ["f_dc_", "f_rest_", "opacity", "scale_", "rot_"] {
            header = header.replace(&format!("float {name}"), &format!("float {prefix}{name}"));
        }
        let read = read_bytes("ply", &[header.as_bytes(), body].concat()).unwrap();
        assert_eq!(read, read_bytes("ply", &plain).unwrap(), "{prefix}");
    }
}

/// Opacities of exactly 1 and 0 have infinite logits, and scales of 0 an infinite logarithm, in files of programs that store bytes. They
/// are kept in memory, and written as finite numbers.
#[test]
fn infinite_logits_are_opacities_of_0_and_1() {
    let folder = tempfile::tempdir().unwrap();
    for (logit, opacity) in [(f32::INFINITY, 1.), (f32::NEG_INFINITY, 0.)] {
        let file = write_changed_ply(folder.path(), "infinite.ply", |columns| {
            set(columns, "opacity", 0, logit.into());
            set(columns, "scale_0", 0, f64::NEG_INFINITY);
        });
        let splat = read_splat(&file).unwrap().select(&[0]);
        assert_eq!((splat.opacity_logits[0], splat.log_scales[0][0]), (logit, f32::NEG_INFINITY));
        assert_eq!((splat.opacity(0), splat.scale(0)[0]), (opacity, 0.));
        let copy = round_trip("ply", &splat);
        assert!((f64::from(copy.opacity(0) - opacity).abs() - OPACITY_MARGIN).abs() < 1e-7);
        assert_eq!(copy.log_scales[0][0], MIN_SCALE.ln() as f32);
        for ending in ["splat", "glb"] {
            let copy = round_trip(ending, &splat);
            assert_eq!((copy.opacity_logits[0], copy.log_scales[0][0]), (logit, f32::NEG_INFINITY));
        }
    }
    let file = write_changed_ply(folder.path(), "large.ply", |columns| set(columns, "scale_0", 0, 89.));
    assert_refused(&file, &["scale_0 of vertex 0 is 89", "at most 88"]);
}

/// Bytes are the colors themselves in older files, without bounds of colors.
#[test]
fn older_compressed_plys_are_read() {
    let bytes = bytes_of("compressed.ply", &random_splat(2, 0, 4));
    let (header, body) = bytes.split_at(body_of_ply(&bytes));
    let mut header = String::from_utf8(header.to_vec()).unwrap();
    for name in ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"] {
        header = header.replace(&format!("property float {name}\n"), "");
    }
    let vertices = &body[18 * 4..];
    let read = read_bytes("ply", &[header.as_bytes(), &body[..12 * 4], vertices].concat()).unwrap();
    let red = f64::from(vertices[15]) / 255.; // the highest byte of the fourth word
    assert!(((red - 0.5) / SH_C0 - f64::from(read.sh[0][0])).abs() < 1e-6);
}

/// 2DGS has no third scale: its Gaussians are flat, with the smallest scale.
#[test]
fn surfels_are_flat() {
    let folder = tempfile::tempdir().unwrap();
    let surfels = folder.path().join("surfels.ply");
    let mut columns = small_gaussians();
    columns.retain(|(name, _)| *name != "scale_2");
    write_ply(&surfels, &columns, &[]);
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
    let (plain, diffuse) = (["red", "green", "blue"], ["diffuse_red", "diffuse_green", "diffuse_blue"]);
    for (names, kind, white, step) in [
        (plain, "uchar", 255., 1e-6),
        (["r", "g", "b"], "float", 1., 1e-6),
        (diffuse, "float", 255., 1e-6),
        (plain, "ushort", 65535., 1e-4),
        (plain, "double", 1., 1e-6),
    ] {
        let whole =
            |byte: f64| if kind == "ushort" { (byte / 255. * white).round() } else { byte / 255. * white };
        let mut columns = small_gaussians();
        columns.retain(|(name, _)| !name.starts_with("f_dc"));
        columns.extend(names.into_iter().zip(bytes.map(|of_rows| of_rows.map(whole))));
        write_ply(&path, &columns, &names.map(|name| (name, kind)));
        let splat = read_splat(&path).unwrap();
        assert_says(&splat.warnings[0], &[&names.join(", "), "f_dc_*"]);
        let color = |row: usize| bytes.map(|of_rows| ((of_rows[row] / 255. - 0.5) / SH_C0) as f32);
        let error = largest_error(splat.sh.as_flattened(), [0, 1, 2].map(color).as_flattened());
        assert!(error < step, "{kind} {names:?}: {error}");
        // If there are coefficients as well, another program derived the colors from them, and they are ignored.
        columns.extend(small_gaussians().into_iter().filter(|(name, _)| name.starts_with("f_dc")));
        write_ply(&path, &columns, &names.map(|name| (name, kind)));
        let splat = read_splat(&path).unwrap();
        assert!(splat.warnings.is_empty() && splat.sh[0][0] == 1.);
    }
}
