//! Chunks with intact archives, whose pickles are arbitrary bytes, or describe scenes.

use super::{load, png, root};
use arbitrary::{Arbitrary, Unstructured};
use globalsplat::data::{Chunk, ChunkWriter};
use std::fs;
use std::io::{Cursor, Write};
use std::path::Path;
use zip::write::{FileOptions, ZipWriter};

/// Returns a torch.save archive of `pickle` and of the numbered storages.
fn archive(pickle: &[u8], storages: &[&[u8]]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(vec![]));
    let mut add = |name: String, contents: &[u8]| {
        let options = FileOptions::default().compression_method(zip::CompressionMethod::Stored);
        zip.start_file(name, options).unwrap();
        zip.write_all(contents).unwrap();
    };
    add("archive/data.pkl".into(), pickle);
    for (key, contents) in storages.iter().enumerate() {
        add(format!("archive/data/{key}"), contents);
    }
    zip.finish().unwrap().into_inner()
}

/// Reads a chunk with the pickle `bytes`; storages 0 to 2 are a photo, two cameras and two timestamps.
pub fn chunk_pickle(bytes: &[u8]) {
    let cameras = [camera(0), camera(1)].concat();
    super::files::chunk(&archive(bytes, &[png(), &cameras, &[0; 16]]));
}

/// Reads a checkpoint with the pickle `bytes`; storages 0 to 2 have 512, 64 and no bytes.
pub fn weights_pickle(bytes: &[u8]) {
    super::files::weights(&archive(bytes, &[&[0; 512], &[0; 64], &[]]));
}

/// Returns the values of a camera, different for each index.
fn camera(index: u8) -> Vec<u8> {
    let (sin, cos) = (f32::from(index) * 0.1).sin_cos();
    let pose = [cos, 0., sin, f32::from(index), 0., 1., 0., 0., -sin, 0., cos, 0.];
    let numbers = [&[0.9, 0.9, 0.5, 0.5, 0., 0.][..], &pose].concat();
    numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
}

#[derive(Arbitrary)]
struct Video {
    key: String,
    url: String,
    views: u8,
    /// Cameras that replace the valid ones.
    cameras: Option<Cameras>,
    timestamps: Option<Array>,
    images: Vec<Image>,
    /// Index of a field that is left out, and one that has a wrong value.
    missing: Option<u8>,
    odd: Option<(u8, Odd)>,
}

#[derive(Arbitrary)]
enum Cameras {
    Numbers([f32; 18]),
    Array(Array),
}

#[derive(Arbitrary)]
enum Image {
    Whole,
    /// Part of the photo's bytes.
    Part(u8, u8),
    Bytes(Vec<u8>),
    Array(Array),
    Odd(Odd),
}

#[derive(Arbitrary, Clone)]
struct Array {
    dtype: u8,
    key: u8,
    device: String,
    length: i32,
    offset: Number,
    size: Vec<Number>,
    stride: Option<Vec<Number>>,
}

#[derive(Arbitrary, Clone)]
enum Number {
    Small(u8),
    Any(i64),
}

#[derive(Arbitrary, Clone)]
enum Odd {
    None,
    True,
    Float([u8; 8]),
    Text(String),
    List(u8),
    Dict,
    Tuple(u8),
    Recalled(u8),
}

const DTYPES: [&str; 11] =
    ["Byte", "Char", "Short", "Int", "Long", "Half", "BFloat16", "Float", "Double", "Bool", "Quantized"];
const FIELDS: [&str; 5] = ["key", "url", "cameras", "timestamps", "images"];

fn text(text: &str) -> Vec<u8> {
    [b"X", &(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

impl Number {
    fn pickled(&self) -> Vec<u8> {
        match self {
            Number::Small(value) => vec![b'K', *value],
            Number::Any(value) => [&[0x8a, 8][..], &value.to_le_bytes()].concat(),
        }
    }
}

fn tuple(numbers: &[Number]) -> Vec<u8> {
    let numbers: Vec<u8> = numbers.iter().flat_map(Number::pickled).collect();
    [b"(", numbers.as_slice(), b"t"].concat()
}

impl Array {
    fn of(dtype: u8, key: u8, size: &[i64]) -> Self {
        let numbers = |values: &[i64]| values.iter().copied().map(Number::Any).collect();
        Array {
            dtype,
            key,
            device: "cpu".into(),
            length: 0,
            offset: Number::Small(0),
            size: numbers(size),
            stride: None,
        }
    }

    fn pickled(&self) -> Vec<u8> {
        let dtype = DTYPES[usize::from(self.dtype) % DTYPES.len()];
        let row_major = || {
            let sizes = self.size.iter().map(|size| match size {
                Number::Small(value) => i64::from(*value),
                Number::Any(value) => *value,
            });
            let mut stride = 1i64;
            let mut strides = vec![];
            for size in sizes.rev() {
                strides.push(Number::Any(stride));
                stride = stride.wrapping_mul(size);
            }
            strides.reverse();
            strides
        };
        [
            b"ctorch._utils\n_rebuild_tensor_v2\n((".to_vec(),
            text("storage"),
            format!("ctorch\n{dtype}Storage\n").into_bytes(),
            text(&self.key.to_string()),
            text(&self.device),
            [b"J", &self.length.to_le_bytes()[..]].concat(),
            b"tQ".to_vec(),
            self.offset.pickled(),
            tuple(&self.size),
            tuple(&self.stride.clone().unwrap_or_else(row_major)),
            b"\x89ccollections\nOrderedDict\n)RtR".to_vec(),
        ]
        .concat()
    }
}

impl Odd {
    fn pickled(&self) -> Vec<u8> {
        match self {
            Odd::None => b"N".to_vec(),
            Odd::True => b"\x88".to_vec(),
            Odd::Float(bytes) => [b"G", &bytes[..]].concat(),
            Odd::Text(value) => text(value),
            Odd::List(count) => [b"](".to_vec(), b"N".repeat((*count).into()), b"e".to_vec()].concat(),
            Odd::Dict => b"}".to_vec(),
            Odd::Tuple(count) => [b"(".to_vec(), b"N".repeat((*count).into()), b"t".to_vec()].concat(),
            Odd::Recalled(id) => vec![b'h', *id],
        }
    }
}

impl Video {
    /// Returns the pickled scene, and adds its data to `storages`.
    fn pickled(&self, storages: &mut Vec<Vec<u8>>) -> Vec<u8> {
        let views = if self.images.is_empty() { self.views % 4 } else { self.images.len() as u8 };
        let mut add = |contents: Vec<u8>| {
            storages.push(contents);
            storages.len() as u8 - 1
        };
        let cameras = match &self.cameras {
            Some(Cameras::Array(array)) => array.clone(),
            numbers => {
                let mut all: Vec<Vec<u8>> = (0..views).map(camera).collect();
                if let (Some(Cameras::Numbers(numbers)), Some(last)) = (numbers, all.last_mut()) {
                    *last = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
                }
                Array::of(7, add(all.concat()), &[views.into(), 18])
            }
        };
        let timestamps = self
            .timestamps
            .clone()
            .unwrap_or_else(|| Array::of(4, add(vec![0; 8 * usize::from(views)]), &[views.into()]));
        let photo = add(png().to_vec());
        let mut image = |image: &Image| match image {
            Image::Whole => Array::of(0, photo, &[png().len() as i64]).pickled(),
            Image::Part(offset, size) => {
                Array { offset: Number::Small(*offset), ..Array::of(0, photo, &[(*size).into()]) }.pickled()
            }
            Image::Bytes(bytes) => Array::of(0, add(bytes.clone()), &[bytes.len() as i64]).pickled(),
            Image::Array(array) => array.pickled(),
            Image::Odd(odd) => odd.pickled(),
        };
        let images: Vec<u8> = match self.images.is_empty() {
            true => (0..views).flat_map(|_| image(&Image::Whole)).collect(),
            false => self.images.iter().flat_map(image).collect(),
        };
        let values = [
            text(&self.key),
            text(&self.url),
            cameras.pickled(),
            timestamps.pickled(),
            [b"](", images.as_slice(), b"e"].concat(),
        ];
        let mut dict = b"}(".to_vec();
        for (index, (field, value)) in FIELDS.iter().zip(values).enumerate() {
            let is = |which: u8| usize::from(which) % FIELDS.len() == index;
            if self.missing.is_some_and(is) {
                continue;
            }
            dict.extend(text(field));
            match &self.odd {
                Some((which, odd)) if is(*which) => dict.extend(odd.pickled()),
                _ => dict.extend(value),
            }
        }
        dict.push(b'u');
        dict
    }
}

/// Reads nearly valid scenes. Some inputs also repack them, which must survive a round trip.
pub fn chunk(bytes: &[u8]) {
    let Ok((packs, videos)) = <(u8, Vec<Video>)>::arbitrary(&mut Unstructured::new(bytes)) else { return };
    let mut storages = vec![];
    let scenes: Vec<u8> = videos.iter().flat_map(|video| video.pickled(&mut storages)).collect();
    let pickle = [b"\x80\x02](", scenes.as_slice(), b"e."].concat();
    let storages: Vec<&[u8]> = storages.iter().map(Vec::as_slice).collect();
    let Ok(chunk) = Chunk::parse(Path::new("chunk.torch"), archive(&pickle, &storages)) else { return };
    for key in chunk.keys().take(2) {
        let Ok(capture) = chunk.capture(key) else { continue };
        load(&capture);
        if packs % 16 > 0 {
            continue;
        }
        let folder = root().join("packed");
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).unwrap();
        let mut writer = ChunkWriter::new(&folder, 1 << 20).unwrap();
        if writer.add(&capture).is_ok() {
            writer.finish().unwrap();
            let again = Chunk::read(&folder.join("000000.torch")).unwrap().capture(key).unwrap();
            assert_eq!(again.len(), capture.len());
        }
    }
}
