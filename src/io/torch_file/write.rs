//! Writer for checkpoints in the format of torch.save, which `torch.load` reads without any of our code: pickle protocol 2, and the bytes
//! of each tensor in a stored entry of a zip archive.

use super::array::row_major;
use crate::error::{Error, Result};
use crate::io::weights::{Stored, Weights};
use crate::io::write_atomically;
use std::collections::HashMap;
use std::io::{Cursor, Write};
use std::path::Path;
use tch::Kind;
use zip::CompressionMethod;
use zip::result::ZipError;
use zip::write::{FileOptions, ZipWriter};

/// Alignment of tensors' bytes in the file, as in torch's own files.
const ALIGNMENT: u16 = 64;
/// Version of the archive's layout.
const VERSION: &[u8] = b"3\n";

/// Entries that Lightning requires. With them it accepts the file as a checkpoint of its own.
const OF_LIGHTNING: &str = "pytorch-lightning_version";
const LIGHTNING_VERSION: &str = "2.0.0";
const COUNTERS: [&str; 2] = ["epoch", "global_step"];

/// Writes a checkpoint atomically, with `weights` as its state dict and their metadata beside it. Lightning can read it too.
///
/// # Errors
/// Returns an error if a tensor's type can't be stored, or if the file can't be written.
pub fn write_checkpoint(path: &Path, weights: &Weights) -> Result<()> {
    let tensors = Stored::all(&weights.tensors)?;
    let pickle = pickle(&tensors, &weights.metadata)?;
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
        for (key, (_, tensor)) in tensors.iter().enumerate() {
            add(&format!("data/{key}"), &tensor.bytes)?;
        }
        add("version", VERSION)
    })();
    let failed = |e: ZipError| Error::failed(format!("{}: {e}", path.display()));
    written.map_err(failed)?;
    let bytes = zip.finish().map_err(failed)?.into_inner();
    write_atomically(path, |writer| writer.write_all(&bytes).map_err(Error::write(path)))
}

fn pickle(tensors: &[(&str, Stored)], metadata: &HashMap<String, String>) -> Result<Vec<u8>> {
    // PROTO 2, EMPTY_DICT, MARK
    let mut p = Pickle(b"\x80\x02}(".into());
    p.text("state_dict");
    p.ordered_dict();
    p.0.push(b'(');
    for (key, (name, Stored { kind, shape, .. })) in tensors.iter().enumerate() {
        let storage = match kind {
            Kind::Float => "FloatStorage",
            Kind::Double => "DoubleStorage",
            Kind::BFloat16 => "BFloat16Storage",
            Kind::Half => "HalfStorage",
            Kind::Int64 => "LongStorage",
            other => return Err(Error::failed(format!("tensors of kind {other:?} are not stored"))),
        };
        p.text(name);
        p.global("torch._utils", "_rebuild_tensor_v2");
        p.0.push(b'(');
        // The persistent id of a storage, BINPERSID.
        p.0.push(b'(');
        p.text("storage");
        p.global("torch", storage);
        p.text(&key.to_string());
        p.text("cpu");
        p.integer(shape.iter().product());
        p.0.extend(b"tQ");
        // The offset, size and stride, requires_grad (NEWFALSE), and no hooks.
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
    strings.push((OF_LIGHTNING, LIGHTNING_VERSION));
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

/// A program for Python's stack machine, built instruction by instruction.
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

    /// Appends a tuple of integers: MARK and TUPLE.
    fn tuple(&mut self, numbers: &[usize]) {
        self.0.push(b'(');
        numbers.iter().for_each(|&number| self.integer(number));
        self.0.push(b't');
    }

    /// Appends a global name: GLOBAL.
    fn global(&mut self, module: &str, name: &str) {
        self.0.extend(format!("c{module}\n{name}\n").as_bytes());
    }

    /// Appends an empty OrderedDict: GLOBAL, EMPTY_TUPLE, REDUCE.
    fn ordered_dict(&mut self) {
        self.global("collections", "OrderedDict");
        self.0.extend(b")R");
    }
}
