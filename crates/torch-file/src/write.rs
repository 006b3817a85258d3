//! Writer for checkpoints in the zip format of `torch.save`, which `torch.load` reads without any code of this project. The archive has an
//! entry with a pickle of protocol 2, and an uncompressed entry with the bytes of each tensor.

use crate::pickle::STORAGES;
use crate::{Error, Result, row_major};
use globalsplat_files::{stored_zip, write_file};
use safetensors::tensor::TensorView;
use std::collections::HashMap;
use std::path::Path;

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

/// A value to be written.
#[derive(Debug)]
pub enum Item<'a> {
    /// String.
    Str(&'a str),
    /// Integer.
    Int(usize),
    /// Tensor, whose bytes are little-endian and in row-major order, of one of the types that torch has a class of storages for.
    Tensor(TensorView<'a>),
    /// List.
    List(Vec<Item<'a>>),
    /// Dict whose keys are strings, in this order.
    Dict(Vec<(&'a str, Item<'a>)>),
    /// Python's `collections.OrderedDict`.
    OrderedDict(Vec<(&'a str, Item<'a>)>),
}

/// Writes a checkpoint to `path` atomically. It is a dict: "state_dict" maps names to `tensors`, as in [`Item::Tensor`], and every other key
/// maps to a string of `metadata`. The keys that Lightning requires are added: "pytorch-lightning_version", "epoch" and "global_step".
///
/// # Errors
/// Returns an error if torch has no storages for a tensor's type, or if the file can't be written.
pub fn write_checkpoint(
    path: &Path,
    tensors: Vec<(&str, TensorView)>,
    metadata: &HashMap<String, String>,
) -> Result<()> {
    let mut strings: Vec<(&str, &str)> = metadata.iter().map(|(k, v)| (k.as_str(), v.as_str())).collect();
    strings.push((LIGHTNING_VERSION_KEY, LIGHTNING_VERSION));
    strings.sort();
    let state = tensors.into_iter().map(|(name, tensor)| (name, Item::Tensor(tensor))).collect();
    let mut root = vec![("state_dict", Item::OrderedDict(state))];
    root.extend(strings.into_iter().map(|(key, text)| (key, Item::Str(text))));
    root.extend(COUNTERS.map(|key| (key, Item::Int(0))));
    let bytes = serialize(&Item::Dict(root))?;
    write_file(path, bytes)
}

/// Returns the contents of a file that holds `root`.
///
/// # Errors
/// Returns an error if torch has no storages for a tensor's type.
pub fn serialize(root: &Item) -> Result<Vec<u8>> {
    // PROTO 2
    let mut pickle = Pickle { bytes: b"\x80\x02".into(), tensors: vec![] };
    pickle.item(root)?;
    // STOP
    pickle.bytes.push(b'.');
    let mut entries = vec![("archive/data.pkl".to_string(), &pickle.bytes[..])];
    entries.push(("archive/byteorder".into(), b"little"));
    let storages = pickle.tensors.iter().enumerate();
    entries.extend(storages.map(|(key, bytes)| (format!("archive/data/{key}"), *bytes)));
    entries.push(("archive/version".into(), VERSION));
    Ok(stored_zip(entries, ALIGNMENT))
}

/// Pickle under construction.
struct Pickle<'a> {
    /// Instructions for the stack machine of Python's unpickler.
    bytes: Vec<u8>,
    /// Bytes of the tensors, in the order in which the pickle refers to them.
    tensors: Vec<&'a [u8]>,
}

impl<'a> Pickle<'a> {
    fn item(&mut self, item: &Item<'a>) -> Result<()> {
        match item {
            Item::Str(text) => self.text(text),
            Item::Int(number) => self.integer(*number),
            Item::Tensor(tensor) => self.tensor(tensor)?,
            Item::List(items) => {
                // EMPTY_LIST, MARK, APPENDS
                self.bytes.extend(b"](");
                items.iter().try_for_each(|item| self.item(item))?;
                self.bytes.push(b'e');
            }
            Item::Dict(items) | Item::OrderedDict(items) => {
                match item {
                    Item::OrderedDict(_) => self.ordered_dict(),
                    _ => self.bytes.push(b'}'), // EMPTY_DICT
                }
                // MARK, SETITEMS
                self.bytes.push(b'(');
                for (key, item) in items {
                    self.text(key);
                    self.item(item)?;
                }
                self.bytes.push(b'u');
            }
        }
        Ok(())
    }

    fn tensor(&mut self, tensor: &TensorView<'a>) -> Result<()> {
        self.global("torch._utils", "_rebuild_tensor_v2");
        let class = STORAGES.iter().find(|(stored, _)| *stored == tensor.dtype()).map(|(_, class)| *class);
        let refused = || Error::failed(format!("tensors of type {} are not stored", tensor.dtype()));
        self.bytes.push(b'(');
        // BINPERSID: the persistent id that refers to a storage.
        self.bytes.push(b'(');
        self.text("storage");
        self.global("torch", class.ok_or_else(refused)?);
        self.text(&self.tensors.len().to_string());
        self.text("cpu");
        self.integer(tensor.shape().iter().product());
        self.bytes.extend(b"tQ");
        // Arguments of the call: storage offset, size, stride, requires_grad (NEWFALSE), and an empty dict of backward hooks.
        self.integer(0);
        self.tuple(tensor.shape());
        self.tuple(&row_major(tensor.shape()));
        self.bytes.push(0x89);
        self.ordered_dict();
        // TUPLE, REDUCE
        self.bytes.extend(b"tR");
        self.tensors.push(tensor.data());
        Ok(())
    }

    /// Appends a string: BINUNICODE.
    fn text(&mut self, text: &str) {
        self.bytes.push(b'X');
        self.bytes.extend((text.len() as u32).to_le_bytes());
        self.bytes.extend(text.as_bytes());
    }

    /// Appends an integer: LONG1 of eight bytes.
    fn integer(&mut self, number: usize) {
        self.bytes.extend([0x8a, 8]);
        self.bytes.extend((number as u64).to_le_bytes());
    }

    /// Appends a tuple of integers, between MARK and TUPLE.
    fn tuple(&mut self, numbers: &[usize]) {
        self.bytes.push(b'(');
        numbers.iter().for_each(|&number| self.integer(number));
        self.bytes.push(b't');
    }

    /// Appends a reference to `module.name`: GLOBAL.
    fn global(&mut self, module: &str, name: &str) {
        self.bytes.extend(format!("c{module}\n{name}\n").as_bytes());
    }

    /// Appends an empty OrderedDict: GLOBAL, EMPTY_TUPLE, REDUCE.
    fn ordered_dict(&mut self) {
        self.global("collections", "OrderedDict");
        self.bytes.extend(b")R");
    }
}
