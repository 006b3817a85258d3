//! Writer for checkpoints in the zip format of `torch.save`, which `torch.load` reads without any code of this project. The archive has an
//! entry with a pickle of protocol 2, and an uncompressed entry with the bytes of each tensor.

use crate::pickle::STORAGES;
use crate::{Dtype, Error, Result, row_major};
use globalsplat_files::write_atomically;
use std::collections::HashMap;
use std::io::{Cursor, Write};
use std::path::Path;
use zip::CompressionMethod;
use zip::result::ZipError;
use zip::write::{FileOptions, ZipWriter};

/// Alignment of each tensor's bytes in the file. Files that torch writes have the same.
const ALIGNMENT: u16 = 64;
/// Contents of the entry `version`: the version of the archive's layout.
const VERSION: &[u8] = b"3\n";

/// Key of Lightning's version, without which Lightning doesn't accept a checkpoint as its own.
const LIGHTNING_VERSION_KEY: &str = "pytorch-lightning_version";
/// Version of Lightning that the checkpoint states.
const LIGHTNING_VERSION: &str = "2.0.0";
/// Other keys that Lightning requires. Their values are 0.
const COUNTERS: [&str; 2] = ["epoch", "global_step"];

/// A tensor to be written.
#[derive(Debug, Clone, Copy)]
pub struct TensorView<'a> {
    /// Name in the state dict.
    pub name: &'a str,
    /// Type of the elements, one of those that torch has a class of storages for.
    pub dtype: Dtype,
    /// Size of each dimension.
    pub shape: &'a [usize],
    /// Elements, little-endian and in row-major order.
    pub bytes: &'a [u8],
}

impl TensorView<'_> {
    /// Returns the name of the class of storages for the type of the elements, after a check of the number of bytes.
    fn storage_class(&self) -> Result<&'static str> {
        let TensorView { name, dtype, shape, bytes } = self;
        let class = STORAGES.iter().find(|(stored, _)| stored == dtype).map(|(_, class)| *class);
        let class = class.ok_or_else(|| Error::failed(format!("tensors of type {dtype} are not stored")))?;
        let size = shape.iter().try_fold(dtype.bitsize() / 8, |size, &count| size.checked_mul(count));
        if size == Some(bytes.len()) {
            return Ok(class);
        }
        Err(Error::failed(format!("tensor {name} has {} bytes for {dtype} {shape:?}", bytes.len())))
    }
}

/// Writes a checkpoint to `path` atomically. It is a dict: "state_dict" maps names to `tensors`, and every other key maps to a string of
/// `metadata`. The keys that Lightning requires are added: "pytorch-lightning_version", "epoch" and "global_step".
///
/// # Errors
/// Returns an error if torch has no storages for a tensor's type, or its bytes don't fit its shape, or if the file can't be written.
pub fn write_checkpoint(
    path: &Path,
    tensors: &[TensorView],
    metadata: &HashMap<String, String>,
) -> Result<()> {
    let pickle = pickle(tensors, metadata)?;
    let mut zip = ZipWriter::new(Cursor::new(vec![]));
    let mut add = |name: &str, contents: &[u8]| {
        let options = FileOptions::default()
            .compression_method(CompressionMethod::Stored)
            .large_file(contents.len() > u32::MAX as usize);
        zip.start_file_aligned(format!("archive/{name}"), options, ALIGNMENT)?;
        zip.write_all(contents).map_err(ZipError::from)
    };
    let written = (|| {
        add("data.pkl", &pickle)?;
        add("byteorder", b"little")?;
        for (key, tensor) in tensors.iter().enumerate() {
            add(&format!("data/{key}"), tensor.bytes)?;
        }
        add("version", VERSION)
    })();
    let failed = |e: ZipError| Error::failed_with_context(path.display())(e);
    written.map_err(failed)?;
    let bytes = zip.finish().map_err(failed)?.into_inner();
    write_atomically(path, |writer| writer.write_all(&bytes).map_err(Error::write(path)))
}

fn pickle(tensors: &[TensorView], metadata: &HashMap<String, String>) -> Result<Vec<u8>> {
    // PROTO 2, EMPTY_DICT, MARK
    let mut p = Pickle(b"\x80\x02}(".into());
    p.text("state_dict");
    p.ordered_dict();
    p.0.push(b'(');
    for (key, tensor @ TensorView { name, shape, .. }) in tensors.iter().enumerate() {
        p.text(name);
        p.global("torch._utils", "_rebuild_tensor_v2");
        p.0.push(b'(');
        // BINPERSID: the persistent id that refers to a storage.
        p.0.push(b'(');
        p.text("storage");
        p.global("torch", tensor.storage_class()?);
        p.text(&key.to_string());
        p.text("cpu");
        p.integer(shape.iter().product());
        p.0.extend(b"tQ");
        // Arguments of the call: storage offset, size, stride, requires_grad (NEWFALSE), and an empty dict of backward hooks.
        p.integer(0);
        p.tuple(shape);
        p.tuple(&row_major(shape));
        p.0.push(0x89);
        p.ordered_dict();
        // TUPLE, REDUCE
        p.0.extend(b"tR");
    }
    // SETITEMS
    p.0.push(b'u');
    let mut strings: Vec<(&str, &str)> = metadata.iter().map(|(k, v)| (k.as_str(), v.as_str())).collect();
    strings.push((LIGHTNING_VERSION_KEY, LIGHTNING_VERSION));
    strings.sort();
    for (key, text) in strings {
        p.text(key);
        p.text(text);
    }
    for key in COUNTERS {
        p.text(key);
        p.integer(0);
    }
    // SETITEMS, STOP
    p.0.extend(b"u.");
    Ok(p.0)
}

/// Pickle under construction: instructions for the stack machine of Python's unpickler.
struct Pickle(Vec<u8>);

impl Pickle {
    /// Appends a string: BINUNICODE.
    fn text(&mut self, text: &str) {
        self.0.push(b'X');
        self.0.extend((text.len() as u32).to_le_bytes());
        self.0.extend(text.as_bytes());
    }

    /// Appends an integer: LONG1 of eight bytes.
    fn integer(&mut self, number: usize) {
        self.0.extend([0x8a, 8]);
        self.0.extend((number as u64).to_le_bytes());
    }

    /// Appends a tuple of integers, between MARK and TUPLE.
    fn tuple(&mut self, numbers: &[usize]) {
        self.0.push(b'(');
        numbers.iter().for_each(|&number| self.integer(number));
        self.0.push(b't');
    }

    /// Appends a reference to `module.name`: GLOBAL.
    fn global(&mut self, module: &str, name: &str) {
        self.0.extend(format!("c{module}\n{name}\n").as_bytes());
    }

    /// Appends an empty OrderedDict: GLOBAL, EMPTY_TUPLE, REDUCE.
    fn ordered_dict(&mut self) {
        self.global("collections", "OrderedDict");
        self.0.extend(b")R");
    }
}
