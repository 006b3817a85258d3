//! Splats and weights, generated with headers of the right structure.

use super::file;
use arbitrary::{Arbitrary, Unstructured};
use globalsplat::config::Config;
use globalsplat::io::{read_splat, read_weights, write_splat};
use globalsplat::reconstruct::{CONFIG_KEY, load_model};
use globalsplat::scene::Gaussians;
use serde_json::{Value, json};
use std::sync::OnceLock;
use tch::Device;

const NUMBER_TYPES: [&str; 9] =
    ["float", "double", "char", "uchar", "short", "ushort", "int", "uint", "quaternion"];

#[derive(Arbitrary)]
struct Ply {
    degree: u8,
    /// Types other than float, each with the index of its property.
    types: Vec<(u8, u8)>,
    /// Index of a property that is left out, and one that occurs twice.
    dropped: Option<u8>,
    added: Option<(u8, u8)>,
    count: Option<u64>,
    /// Line inserted into the header, with its position.
    line: Option<(u8, String)>,
    body: Vec<u8>,
}

/// Reads a generated PLY; a splat that can be read must survive a round trip.
pub fn ply(bytes: &[u8]) {
    let Ok(made) = Ply::arbitrary(&mut Unstructured::new(bytes)) else { return };
    let rest = [0, 9, 24, 45, 7][usize::from(made.degree) % 5];
    let mut names: Vec<String> = ["x", "y", "z", "opacity"].map(String::from).into();
    for (prefix, count) in [("f_dc_", 3), ("f_rest_", rest), ("scale_", 3), ("rot_", 4)] {
        names.extend((0..count).map(|k| format!("{prefix}{k}")));
    }
    let mut properties: Vec<(String, &str)> = names.into_iter().map(|name| (name, "float")).collect();
    for (property, kind) in &made.types {
        let at = usize::from(*property) % properties.len();
        properties[at].1 = NUMBER_TYPES[usize::from(*kind) % NUMBER_TYPES.len()];
    }
    if let Some((from, to)) = made.added {
        let property = properties[usize::from(from) % properties.len()].clone();
        properties.insert(usize::from(to) % properties.len(), property);
    }
    if let Some(dropped) = made.dropped {
        properties.remove(usize::from(dropped) % properties.len());
    }
    let size = |kind: &str| match kind {
        "char" | "uchar" => 1,
        "short" | "ushort" => 2,
        "double" => 8,
        _ => 4,
    };
    let stride: usize = properties.iter().map(|(_, kind)| size(kind)).sum();
    let count = made.count.unwrap_or((made.body.len() / stride) as u64);
    let mut lines = vec!["format binary_little_endian 1.0".to_string(), format!("element vertex {count}")];
    lines.extend(properties.iter().map(|(name, kind)| format!("property {kind} {name}")));
    if let Some((at, line)) = &made.line {
        lines.insert(usize::from(*at) % lines.len(), line.clone());
    }
    let contents = [format!("ply\n{}\nend_header\n", lines.join("\n")).as_bytes(), &made.body].concat();
    let Ok(splat) = read_splat(&file("made_ply", "splat.ply", &contents)) else { return };
    let copy = file("made_ply", "copy.ply", b"");
    if write_splat(&copy, &splat).is_ok() {
        let again = read_splat(&copy).unwrap();
        assert_eq!((&again.means, again.sh_degree), (&splat.means, splat.sh_degree));
        Gaussians::from_splat(&again).to_splat(again.origin).unwrap();
    }
}

#[derive(Arbitrary)]
struct Weights {
    tensors: Vec<Stored>,
    metadata: Option<Metadata>,
    /// Length that replaces the header's own.
    length: Option<u64>,
    body: Vec<u8>,
}

#[derive(Arbitrary)]
struct Stored {
    name: Result<u16, String>,
    dtype: u8,
    shape: Vec<Size>,
    /// Data offsets; by default the tensor follows the one before it.
    offsets: Option<[u64; 2]>,
}

#[derive(Arbitrary, Clone, Copy)]
enum Size {
    Small(u8),
    Any(u64),
}

#[derive(Arbitrary)]
enum Metadata {
    /// Configuration of a small model.
    Small,
    Key(u8, i64),
    Text(String),
}

const DTYPES: [(&str, u64); 9] = [
    ("F32", 4),
    ("BF16", 2),
    ("F16", 2),
    ("F64", 8),
    ("I64", 8),
    ("U8", 1),
    ("BOOL", 1),
    ("I32", 4),
    ("F8_E4M3", 1),
];

/// Returns the configuration of a model with few weights, and their names.
fn small() -> &'static (String, Vec<String>) {
    static SMALL: OnceLock<(String, Vec<String>)> = OnceLock::new();
    SMALL.get_or_init(|| {
        let sizes =
            ["latents=4", "width=8", "rgb_width=8", "ray_width=8", "rounds=1", "heads=2", "candidates=2"];
        let mut settings: Vec<String> = sizes.iter().map(|size| format!("model.{size}")).collect();
        settings.extend(["curriculum.final_stage=1".into(), "model.self_attention_blocks=1".into()]);
        let config = Config::parse("", &settings, "small".as_ref()).unwrap();
        let vs = tch::nn::VarStore::new(Device::Cpu);
        globalsplat::model::GlobalSplat::new(&vs.root(), &config.model).unwrap();
        let mut names: Vec<String> = vs.variables().into_keys().collect();
        names.sort();
        (config.to_toml(), names)
    })
}

/// Reads generated weights, and the model if they are one.
pub fn weights(bytes: &[u8]) {
    let Ok(made) = Weights::arbitrary(&mut Unstructured::new(bytes)) else { return };
    let (config, names) = small();
    let mut header = serde_json::Map::new();
    let mut end = 0u64;
    for stored in &made.tensors {
        let name = match &stored.name {
            Ok(index) => names[usize::from(*index) % names.len()].clone(),
            Err(name) => name.clone(),
        };
        let (dtype, size) = DTYPES[usize::from(stored.dtype) % DTYPES.len()];
        let shape = stored.shape.iter().map(|&size| match size {
            Size::Small(size) => size.into(),
            Size::Any(size) => size,
        });
        let shape: Vec<u64> = shape.collect();
        let bytes = shape.iter().fold(size, |bytes, &size| bytes.wrapping_mul(size));
        let offsets = stored.offsets.unwrap_or([end, end.wrapping_add(bytes)]);
        end = offsets[1];
        header.insert(name, json!({"dtype": dtype, "shape": shape, "data_offsets": offsets}));
    }
    if let Some(metadata) = &made.metadata {
        let text = match metadata {
            Metadata::Small => config.clone(),
            Metadata::Key(line, value) => {
                let mut lines: Vec<String> = config.lines().map(String::from).collect();
                let at = usize::from(*line) % lines.len();
                if let Some((key, _)) = lines[at].split_once(" = ") {
                    lines[at] = format!("{key} = {value}");
                }
                lines.join("\n")
            }
            Metadata::Text(text) => text.clone(),
        };
        header.insert("__metadata__".into(), json!({ CONFIG_KEY: text }));
    }
    let header = Value::Object(header).to_string();
    let length = made.length.unwrap_or(header.len() as u64);
    let contents = [&length.to_le_bytes()[..], header.as_bytes(), &made.body].concat();
    let file = file("made_weights", "model.safetensors", &contents);
    let _ = read_weights(&file);
    let _ = load_model(&file, Device::Cpu);
}
