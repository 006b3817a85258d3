//! glTF: its bytes, files as of other programs, and invalid files.

use super::common::{
    assert_bytes_refused, assert_changes_refused, assert_refused, assert_says, assert_within, bytes_of,
    largest_error, random_splat, read_bytes, refusal, written,
};
use base64::prelude::{BASE64_STANDARD, Engine};
use glam::{DMat4, DQuat, DVec3};
use globalsplat_splat_file::{SH_C0, Splat, check_writable_splat, read_splat, splat_files, write_splat};
use serde_json::{Value, json};

/// Contents of a `.glb`.
#[derive(Clone)]
struct Glb {
    json: Value,
    bin: Vec<u8>,
}

impl Glb {
    fn new(splat: &Splat) -> Self {
        let bytes = bytes_of("glb", splat);
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
        let (length, kind) = (word(12), &bytes[16..20]);
        assert_eq!((length % 4, kind), (0, &b"JSON"[..]));
        let (json, bin) = bytes[20..].split_at(length);
        assert_eq!((word(20 + length), &bin[4..8]), (bin.len() - 8, &b"BIN\0"[..]));
        assert_eq!(bin.len() % 4, 0);
        Glb { json: serde_json::from_slice(json).unwrap(), bin: bin[8..].to_vec() }
    }

    fn bytes(&self) -> Vec<u8> {
        let mut json = self.json.to_string().into_bytes();
        json.resize(json.len().next_multiple_of(4), b' ');
        let mut bin = self.bin.clone();
        bin.resize(bin.len().next_multiple_of(4), 0);
        let length = 12 + 8 + json.len() + 8 + bin.len();
        let word = |number: usize| (number as u32).to_le_bytes();
        let header = [*b"glTF", word(2), word(length), word(json.len()), *b"JSON"];
        let body = [word(bin.len()), *b"BIN\0"];
        [header.as_flattened(), &json, body.as_flattened(), &bin].concat()
    }

    fn read(&self) -> Splat {
        read_bytes("glb", &self.bytes()).unwrap()
    }

    /// Checks that the file is refused with a message that contains all of `parts` after the value at a JSON pointer is set.
    #[track_caller]
    fn assert_refused_with(&self, pointer: &str, value: Value, parts: &[&str]) {
        let (parent, key) = pointer.rsplit_once('/').unwrap();
        let mut changed = self.clone();
        match changed.json.pointer_mut(parent).unwrap() {
            Value::Array(items) => items[key.parse::<usize>().unwrap()] = value,
            object => object[key] = value,
        }
        assert_bytes_refused("glb", &changed.bytes(), parts);
    }

    fn primitive(&mut self) -> &mut Value {
        &mut self.json["meshes"][0]["primitives"][0]
    }

    fn remove_attribute(&mut self, name: &str) {
        self.primitive()["attributes"].as_object_mut().unwrap().remove(name).expect("an attribute");
    }

    fn accessor(&mut self, attribute: &str) -> &mut Value {
        let index = self.primitive()["attributes"][attribute].as_u64().expect("an attribute");
        &mut self.json["accessors"][index as usize]
    }

    /// Returns the bytes of an attribute.
    fn numbers(&mut self, attribute: &str) -> &mut [u8] {
        let view = self.accessor(attribute)["bufferView"].as_u64().unwrap() as usize;
        let view = &self.json["bufferViews"][view];
        let [offset, length] = ["byteOffset", "byteLength"].map(|name| view[name].as_u64().unwrap() as usize);
        &mut self.bin[offset..][..length]
    }

    /// Replaces the numbers of an attribute by `bytes` in a buffer view of their own, whose index it returns.
    fn set(&mut self, attribute: &str, bytes: &[u8], accessor: Value) -> usize {
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        let view = json!({"buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len()});
        self.bin.extend(bytes);
        self.json["buffers"][0]["byteLength"] = json!(self.bin.len());
        let views = self.json["bufferViews"].as_array_mut().unwrap();
        views.push(view);
        let index = views.len() - 1;
        *self.accessor(attribute) = accessor;
        self.accessor(attribute)["bufferView"] = json!(index);
        index
    }
}

const ROTATION: &str = "KHR_gaussian_splatting:ROTATION";
const SCALE: &str = "KHR_gaussian_splatting:SCALE";
const OPACITY: &str = "KHR_gaussian_splatting:OPACITY";

/// Checks that two splats have the same Gaussians but for rounding.
fn assert_same(what: &str, a: &Splat, b: &Splat) {
    assert_eq!(a.sh_degree, b.sh_degree, "{what}");
    assert_within(what, a, b, [1e-5; 7]);
}

/// A .glb has the bounds, the colors and the properties that the extension requires. Babylon.js reads its numbers in
/// parity/tests/test_splat_formats.py.
#[test]
fn a_glb_is_as_documented() {
    let splat = random_splat(3, 3, 1);
    let mut glb = Glb::new(&splat);
    for (axis, sign) in [-1., -1., 1.].into_iter().enumerate() {
        let numbers = || splat.means.iter().map(|mean| sign * mean[axis]);
        let bounds = [numbers().reduce(f32::min), numbers().reduce(f32::max)];
        let found = ["min", "max"].map(|bound| glb.accessor("POSITION")[bound][axis].as_f64());
        assert_eq!(found, bounds.map(|bound| bound.map(f64::from)));
    }
    let color = glb.accessor("COLOR_0").clone();
    assert_eq!((&color["componentType"], &color["normalized"]), (&json!(5121), &json!(true)));
    let byte = |fraction: f64| (fraction * 255.).round() as u8;
    let [red, green, blue] = splat.sh_of(0)[0].map(|dc| byte(f64::from(dc) * SH_C0 + 0.5));
    assert_eq!(glb.numbers("COLOR_0")[..4], [red, green, blue, byte(splat.opacity(0).into())]);
    assert_eq!(glb.json["extensionsUsed"], json!(["KHR_gaussian_splatting"]));
    let properties = json!({
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    });
    assert_eq!(glb.primitive()["extensions"]["KHR_gaussian_splatting"], properties);
    assert_eq!(glb.primitive()["mode"], 0);
}

/// The transforms of a node and all its parents are applied, as matrices or in parts.
#[test]
fn nodes_move_gaussians() {
    let splat = random_splat(40, 3, 2);
    let mut glb = Glb::new(&splat);
    let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -1., 2.);
    let parts = DMat4::from_scale_rotation_translation(DVec3::splat(0.5), turn, DVec3::new(1., -2., 3.));
    let matrix = DMat4::from_scale_rotation_translation(DVec3::splat(3.), turn, DVec3::new(4., 0., -1.));
    glb.json["nodes"] = json!([
        {"mesh": 0, "translation": [1., -2., 3.], "rotation": turn.to_array(), "scale": [0.5, 0.5, 0.5]},
        {"children": [0], "name": "no transform"},
        {"matrix": matrix.to_cols_array(), "children": [1]},
    ]);
    glb.json["scenes"][0]["nodes"] = json!([2]);
    // Half a turn about z, from the axes of other formats to those of glTF and back.
    let half_turn = DMat4::from_scale(DVec3::new(-1., -1., 1.));
    let world = half_turn * matrix * parts * half_turn;
    let expected = splat.transformed(&world).unwrap();
    let read = glb.read();
    assert_same("nodes", &expected, &read);
    assert!(read.linear_scales.is_some());
    glb.json.as_object_mut().unwrap().remove("scene");
    assert_same("the first scene", &expected, &glb.read());
    for (pointer, value, message) in [
        ("/nodes/0/scale", json!([1., 1., 2.]), "node 0, with those of its parents, is one whose axes"),
        ("/nodes/0/scale", json!([1., 1., -1.]), "the transform of node 0"),
        ("/nodes/0/rotation", json!([0, 0, 0, 0]), "the transform of node 0"),
        ("/nodes/2/children", json!([7]), "node 7 is missing, expected an index below 3"),
        ("/nodes/0/children", json!([2]), "node 2 is reached twice, expected a tree"),
        ("/scenes/0/nodes", json!([2, 1]), "node 1 is reached twice"),
        ("/scene", json!(1), "scene 1 is missing"),
        ("/nodes/0/mesh", json!(3), "mesh 3 is missing, expected an index below 1"),
    ] {
        glb.assert_refused_with(pointer, value, &[message]);
    }
}

/// Primitives of all nodes are joined, with spherical harmonics of the highest degree, and other primitives are counted.
#[test]
fn primitives_are_joined() {
    let splat = random_splat(20, 2, 3);
    let mut glb = Glb::new(&splat);
    let mut flat = glb.primitive().clone();
    let attributes = flat["attributes"].as_object_mut().unwrap();
    attributes.retain(|name, _| !name.contains("DEGREE_1") && !name.contains("DEGREE_2"));
    let triangles = json!({"attributes": {"POSITION": 0}});
    glb.json["meshes"] = json!([
        {"primitives": [glb.primitive().clone(), triangles]},
        {"primitives": [flat, triangles]},
        {"primitives": [triangles]},
    ]);
    glb.json["nodes"] = json!([{"mesh": 0}, {"mesh": 1, "translation": [0, 0, 1]}, {"mesh": 2}]);
    glb.json["scenes"][0]["nodes"] = json!([0, 1, 2]);
    let read = glb.read();
    assert_eq!((read.len(), read.sh_degree), (40, 2));
    let [first, second] = [0..20, 20..40].map(|range| read.select(&range.collect::<Vec<_>>()));
    let moved = splat.transformed(&DMat4::from_translation(DVec3::Z)).unwrap();
    assert_same("the first", &splat, &first);
    assert_same("the second", &moved.with_sh_degree(0).with_sh_degree(2), &second);
    assert_says(&read.warnings[0], &["3 of 5 mesh primitives are left out, which aren't Gaussian splats"]);
    for primitive in [0, 1] {
        glb.json["meshes"][primitive]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["kernel"] =
            json!("cone");
    }
    assert_says(&glb.read().warnings[1], &["a.glb: kernel \"cone\" is read as ellipse"]);
    assert_eq!(glb.read().warnings.len(), 2, "each message once");
    let message = "the scene is without Gaussian splats, but with 1 other mesh primitives";
    glb.assert_refused_with("/scenes/0/nodes", json!([2]), &[message]);
}

/// Quantized attributes, strides and offsets are read.
#[test]
fn quantized_and_interleaved_attributes_are_read() {
    let mut glb = Glb::new(&random_splat(2, 0, 6));
    // Positions of 16 bits at byte 2 and scales of 8 bits at byte 8 share a buffer view with a stride of 12 bytes.
    let bytes = [9, 9, 254, 255, 3, 0, 0, 1, 1, 2, 255, 9, 9, 9, 1, 0, 0, 0, 255, 255, 4, 5, 6];
    let position = json!({"componentType": 5122, "count": 2, "type": "VEC3", "byteOffset": 2});
    let view = glb.set("POSITION", &bytes, position);
    glb.json["bufferViews"][view]["byteStride"] = json!(12);
    *glb.accessor(SCALE) =
        json!({"componentType": 5121, "count": 2, "type": "VEC3", "byteOffset": 8, "bufferView": view});
    let rotation = json!({"componentType": 5120, "normalized": true, "count": 2, "type": "VEC4"});
    glb.set(ROTATION, &[0, 0, 0, 127, 128, 0, 0, 0], rotation);
    let opacity = json!({"componentType": 5123, "normalized": true, "count": 2, "type": "SCALAR"});
    glb.set(OPACITY, &[255, 255, 0x33, 0x33], opacity);
    glb.json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    let read = glb.read();
    // After half a turn back about z; −128 is −1, too.
    assert_eq!(read.means, [[2., -3., 256.], [-1., 0., -1.]]);
    assert_eq!(read.linear_scales.as_ref().unwrap(), &[[1., 2., 255.], [4., 5., 6.]]);
    assert_eq!(read.quaternions, [[0., 0., 0., -1.], [0., 0., 1., 0.]]);
    assert_eq!(read.opacity_logits[0], f32::INFINITY);
    assert!((read.opacity(1) - 0.2).abs() < 1e-7);
    let view = format!("/bufferViews/{view}");
    let short = ["the extent of accessor", SCALE, "2 elements, which end at byte 23", "the 22 bytes"];
    glb.assert_refused_with(&format!("{view}/byteLength"), json!(22), &short);
    let stride = ["the stride of accessor", "(POSITION) is 4, expected 6 bytes or more"];
    glb.assert_refused_with(&format!("{view}/byteStride"), json!(4), &stride);
}

/// splat-transform wrote the logarithms of scales before version 2.7. Scales of other programs that are mostly negative are refused, since
/// they may be logarithms, too.
#[test]
fn logarithms_of_scales_are_read() {
    let splat = random_splat(20, 1, 3);
    let mut glb = Glb::new(&splat);
    let logs = splat.log_scales.as_flattened().iter().flat_map(|log| log.to_le_bytes());
    glb.numbers(SCALE).copy_from_slice(&logs.collect::<Vec<_>>());
    for generator in ["splat-transform v2.6.0", "splat-transform 1.9.2"] {
        glb.json["asset"]["generator"] = json!(generator);
        let read = glb.read();
        assert_same(generator, &splat, &read);
        assert_eq!((&read.log_scales, &read.linear_scales), (&splat.log_scales, &None));
        assert_says(
            &read.warnings[0],
            &["scales are read as logarithms, as splat-transform wrote them before 2.7"],
        );
    }
    let message = [
        &format!("{SCALE} of primitive 0 of mesh 0 is negative for the most part"),
        "expected lengths of 0 or more",
    ];
    for generator in [
        json!("splat-transform v2.7.0"),
        json!("splat-transform v3.0.0"),
        json!("splat-transform"),
        json!(null),
    ] {
        glb.assert_refused_with("/asset/generator", generator, &message);
    }
}

/// Colors and opacities come from COLOR_0 if the attributes of the extension are absent, as in files of its drafts.
#[test]
fn colors_are_a_fallback() {
    let splat = random_splat(50, 0, 4);
    let mut glb = Glb::new(&splat);
    glb.remove_attribute("KHR_gaussian_splatting:SH_DEGREE_0_COEF_0");
    let read = glb.read();
    assert!(largest_error(read.sh.as_flattened(), splat.sh.as_flattened()) < 0.51 / 255. / SH_C0);
    assert_eq!(read.opacity(7), splat.opacity(7));
    glb.remove_attribute(OPACITY);
    assert!((glb.read().opacity(7) - splat.opacity(7)).abs() < 0.51 / 255.);
    glb.remove_attribute("COLOR_0");
    let message = format!("the attribute {OPACITY} of primitive 0 of mesh 0 is missing");
    assert_bytes_refused("glb", &glb.bytes(), &[&message]);
}

/// A buffer is a file beside the .gltf, whose name is percent-encoded, or a data URI.
#[test]
fn buffers_are_files_or_data() {
    let folder = tempfile::tempdir().unwrap();
    let splat = random_splat(300, 1, 8);
    let path = written(folder.path(), "my room, große: b.gltf", &splat);
    let buffer = folder.path().join("my room, große: b.bin");
    let mut json: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    assert_eq!(json["buffers"][0]["uri"], "my%20room%2C%20gro%C3%9Fe%3A%20b.bin");
    let bin = std::fs::read(&buffer).unwrap();
    let glb = Glb::new(&splat);
    assert_eq!((&json["accessors"], &bin), (&glb.json["accessors"], &glb.bin));
    assert_same("a file", &splat, &read_splat(&path).unwrap());
    assert_eq!(splat_files(&path)[2], buffer);
    assert_eq!(splat_files(&path.with_extension("glb")).len(), 2);
    let one = json["buffers"][0].clone();
    let mut other = one.clone();
    other["uri"] = json!("./my%20room%2C%20große%3A%20b.bin");
    json["buffers"] = json!([one, other]);
    json["bufferViews"][1]["buffer"] = json!(1);
    std::fs::write(&path, json.to_string()).unwrap();
    assert_same("two buffers of a file", &splat, &read_splat(&path).unwrap());
    // The file counts once among the bytes that may hold Gaussians.
    json["nodes"] = vec![json!({"mesh": 0}); 2000].into();
    json["scenes"][0]["nodes"] = (0..2000).collect();
    let text = json.to_string();
    std::fs::write(&path, &text).unwrap();
    assert_refused(&path, &[&format!("256 times the file's {} bytes", text.len() + bin.len())]);
    (json["nodes"], json["scenes"][0]["nodes"]) = (json!([{"mesh": 0}]), json!([0]));
    json["bufferViews"][1]["buffer"] = json!(0);
    json["buffers"] = json!([one]);
    std::fs::write(&path, json.to_string()).unwrap();
    std::fs::write(&buffer, &bin[1..]).unwrap();
    assert_refused(&path, &["b.bin: buffer 0 is cut short: ", "bytes, expected "]);
    std::fs::remove_file(&buffer).unwrap();
    assert_refused(&path, &["b.bin can't be read"]);
    std::fs::create_dir(&buffer).unwrap();
    assert_refused(&path, &["b.bin"]);

    let mut read_with = |uri: &str| {
        json["buffers"][0]["uri"] = json!(uri);
        std::fs::write(&path, json.to_string()).unwrap();
        read_splat(&path)
    };
    let data =
        |bytes: &[u8]| format!("data:application/gltf-buffer;base64,{}", BASE64_STANDARD.encode(bytes));
    assert_same("a data URI", &splat, &read_with(&data(&bin)).unwrap());
    for (uri, message) in [
        ("/etc/hostname", "expected a data URI, or a path relative to"),
        ("%2Fetc/hostname", "the uri of buffer 0 is"),
        ("https://a.org/b.bin", "the uri of buffer 0 is"),
        ("%ff", "the uri of buffer 0 is"),
        ("", "the uri of buffer 0 is"),
        ("data:application/octet-stream,abc", "buffer 0 is another or a damaged data URI"),
        ("data:;base64,a~~~", "buffer 0 is another or a damaged data URI"),
        (&data(&bin[4..]), "buffer 0 is cut short"),
    ] {
        assert_says(&refusal(read_with(uri)), &[message]);
    }
}

/// Both files of a .gltf are checked before the work, and neither changes if the other can't be written.
#[test]
fn a_gltf_is_written_with_its_buffer_or_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let path = written(folder.path(), "a.gltf", &random_splat(3, 0, 1));
    let before = std::fs::read(&path).unwrap();
    std::fs::remove_file(folder.path().join("a.bin")).unwrap();
    let other = folder.path().join("b.gltf");
    for blocked in [&folder.path().join("a.bin"), &other] {
        std::fs::create_dir(blocked).unwrap();
    }
    assert_says(&check_writable_splat(&path).unwrap_err().to_string(), &["a.bin"]);
    assert_says(&write_splat(&path, &random_splat(5, 0, 1)).unwrap_err().to_string(), &["a.bin"]);
    assert_eq!(std::fs::read(&path).unwrap(), before);
    assert_says(&write_splat(&other, &random_splat(5, 0, 1)).unwrap_err().to_string(), &["b.gltf"]);
    for name in ["c.glb", "c.gltf"] {
        let error = write_splat(&folder.path().join(name), &Splat::default()).unwrap_err();
        assert_says(&error.to_string(), &["glTF holds one Gaussian at least, found 0"]);
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 3);
}

/// The numbers of an SPZ in a glTF file are in glTF's axes.
#[test]
fn spzs_inside_are_read() {
    let splat = Splat { antialiased: true, ..random_splat(60, 3, 9) };
    let bin = bytes_of("spz", &splat);
    let read = read_bytes("spz", &bin).unwrap();
    let mut glb = Glb { bin, ..Glb::new(&splat) };
    let length = json!(glb.bin.len());
    let extension = "KHR_gaussian_splatting_compression_spz_2";
    glb.json["extensionsRequired"] = json!([extension]);
    glb.json["bufferViews"] = json!([{"buffer": 0, "byteLength": length}]);
    glb.json["buffers"][0]["byteLength"] = length;
    glb.primitive()["extensions"]["KHR_gaussian_splatting"] =
        json!({"extensions": {extension: {"bufferView": 0}}});
    let inside = glb.read();
    // The SPZ has (x, −y, −z), which is read as (−x, y, −z): half a turn about y.
    let means: Vec<[f32; 3]> = read.means.iter().map(|&[x, y, z]| [-x, y, -z]).collect();
    assert_eq!(inside.means, means);
    let mut turned = read.transformed(&DMat4::from_rotation_y(std::f64::consts::PI)).unwrap();
    // Half a turn about a Gaussian's own x axis doesn't change it.
    turned.quaternions.iter_mut().for_each(|quaternion| {
        let [w, x, y, z] = *quaternion;
        *quaternion = [-x, w, z, -y];
    });
    assert_same("an SPZ", &turned, &inside);
    assert!(inside.antialiased && inside.warnings.is_empty() && inside.linear_scales.is_none());
    let short = json!(glb.bin.len() - 1);
    glb.assert_refused_with("/bufferViews/0/byteLength", short, &["a.glb: stream 5 is cut short"]);
    let message = ["buffer view 0 is", "bytes at 1, expected a part of buffer 0"];
    glb.assert_refused_with("/bufferViews/0/byteOffset", json!(1), &message);
}

#[test]
fn bad_glbs() {
    let glb = Glb::new(&random_splat(30, 1, 9));
    let whole = glb.bytes();
    let cases: [(usize, &[u8], &str); 5] = [
        (4, &[1], "the version of the .glb is 1, expected 2"),
        (11, &[255], "the length in the header is"),
        (16, b"X", "the first chunk is of type \"XSON\""),
        (15, &[255], "a chunk is cut short"),
        (20, b"[", "the JSON is invalid: "),
    ];
    assert_changes_refused("glb", &whole, &cases);
    for length in (0..whole.len()).filter(|length| *length < 40 || length % 53 == 0) {
        refusal(read_bytes("glb", &whole[..length]));
    }
    let position = "/meshes/0/primitives/0/attributes/POSITION";
    let index = &glb.json["meshes"][0]["primitives"][0]["attributes"][SCALE];
    let scale = |key: &str| format!("/accessors/{index}/{key}");
    for (pointer, value, message) in [
        ("/asset/version".into(), json!("1.0"), "the version is \"1.0\", expected 2.0"),
        // A long text with line breaks is still one short sentence.
        ("/asset/version".into(), json!("a\n".repeat(1000)), "a\\n\", expected 2.0"),
        ("/extensionsRequired".into(), json!(["A"]), "is \"A\", expected KHR_gaussian_splatting,"),
        ("/meshes/0/primitives/0/mode".into(), json!(4), "primitive 0 of mesh 0 is 4, expected 0 (POINTS)"),
        (position.into(), json!(99), "the accessor of POSITION, 99 is missing"),
        (scale("type"), json!("VEC4"), "is \"VEC4\", expected VEC3"),
        (scale("componentType"), json!(5125), "is 5125, expected float"),
        (scale("count"), json!(29), "is 29, expected 30, as many as positions"),
        (scale("count"), json!(-1), "the JSON is invalid"),
        (scale("sparse"), json!({"count": 1}), "is sparse"),
        (scale("bufferView"), json!(null), "is missing"),
        (scale("bufferView"), json!(99), "buffer view 99 is missing"),
        ("/accessors/0/count".into(), json!(usize::MAX), "the extent of accessor 0 (POSITION)"),
        ("/accessors/0/count".into(), json!(0), "is 0 elements"),
        ("/accessors/0/byteOffset".into(), json!(usize::MAX), "the extent of accessor 0"),
        ("/bufferViews/0/byteLength".into(), json!(usize::MAX), "view 0 is 18446744073709551615 bytes at 0"),
        ("/bufferViews/0/byteOffset".into(), json!(usize::MAX), "buffer view 0 is"),
        ("/bufferViews/0/buffer".into(), json!(1), "buffer 1 is missing, expected an index below 1"),
        ("/buffers/0/byteLength".into(), json!(1_000_000_000_000u64), "buffer 0 is cut short"),
    ] {
        glb.assert_refused_with(&pointer, value, &[message]);
    }
    for missing in ["POSITION", ROTATION, SCALE, "KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"] {
        let mut changed = glb.clone();
        changed.remove_attribute(missing);
        let message = format!("the attribute {missing} of primitive 0 of mesh 0 is missing");
        assert_bytes_refused("glb", &changed.bytes(), &[&message]);
    }
    for (attribute, at, value, message) in [
        (OPACITY, 4, f32::NAN, "the opacity of Gaussian 1 is NaN"),
        (OPACITY, 4, 1.5, "the opacity of Gaussian 1 is NaN"),
        (OPACITY, 4, -0.1, "the opacity of Gaussian 1 is NaN"),
        (SCALE, 16, -1e-9, "the scale of Gaussian 1 is -0.000000001, expected 0 or more"),
    ] {
        let mut changed = glb.clone();
        changed.numbers(attribute)[at..at + 4].copy_from_slice(&value.to_le_bytes());
        assert_bytes_refused("glb", &changed.bytes(), &[message, "`globalsplat convert` leaves out"]);
    }
}

/// Meshes that many nodes share can't fill the memory.
#[test]
fn shared_meshes_are_limited() {
    let mut glb = Glb::new(&random_splat(20_000, 0, 1));
    let nodes = vec![json!({"mesh": 0}); 400];
    let all: Vec<usize> = (0..nodes.len()).collect();
    glb.json["nodes"] = json!(nodes);
    glb.json["scenes"][0]["nodes"] = json!(all);
    assert_bytes_refused("glb", &glb.bytes(), &["the number of Gaussians is ", "256 times the file's "]);
    glb.json["scenes"][0]["nodes"] = json!([0, 1, 2]);
    assert_eq!(glb.read().len(), 60_000);
    // A chain of nodes as long as the file allows needs no recursion.
    let chain: Vec<Value> = (0..100_000).map(|index| json!({"children": [index + 1]})).collect();
    glb.json["nodes"] = [chain, vec![json!({"mesh": 0})]].concat().into();
    glb.json["scenes"][0]["nodes"] = json!([0]);
    assert_eq!(glb.read().len(), 20_000);
}
