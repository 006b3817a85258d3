//! Weights of models: safetensors files, whose metadata hold the configuration that rebuilds their model, and checkpoints that torch.save
//! wrote.

use super::write_file;
use crate::error::{Error, Result};
use globalsplat_torch_file::{self as torch_file, Array, Dtype, TorchFile, Value, is_torch_file, row_major};
use memmap2::{Mmap, MmapOptions};
use safetensors::tensor::TensorView;
use safetensors::{SafeTensorError, SafeTensors};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs::File;
use std::path::{Path, PathBuf};
use tch::{Device, Kind, Tensor, nn};

/// Contents of a safetensors file.
#[derive(Debug)]
pub struct Weights {
    /// Tensors by name, on the host, in their stored type.
    pub tensors: BTreeMap<String, Tensor>,
    /// Metadata of the file, its `__metadata__`.
    pub metadata: HashMap<String, String>,
}

impl Weights {
    /// Copies the weights into the variables of `vs`, which keep their type and device.
    ///
    /// # Errors
    /// Returns an error if names or shapes don't match, before anything is copied: it names the first mismatch and counts the others.
    pub fn load_into(&self, vs: &nn::VarStore, file: &Path) -> Result<()> {
        let shapes = self.tensors.iter().map(|(name, t)| (name.as_str(), t.size())).collect();
        fit(vs, &shapes, file, |name, variable| {
            variable.f_copy_(&self.tensors[name]).map_err(Error::external)
        })
    }
}

/// Writes a safetensors file atomically.
///
/// # Errors
/// Returns an error if the file can't be written.
pub fn write_weights(
    path: &Path,
    tensors: &BTreeMap<String, Tensor>,
    metadata: HashMap<String, String>,
) -> Result<()> {
    let contents = contents_of(tensors)?;
    let failed = |e| Error::failed(format!("{}: weights can't be serialized: {e}", path.display()));
    let mut bytes = safetensors::serialize(views(tensors, &contents)?, Some(metadata)).map_err(failed)?;
    sort_header(&mut bytes);
    write_file(path, bytes)
}

/// Sorts the metadata in the header. They come in the order of a hash map, which differs between processes; sorted, equal weights give
/// equal bytes.
fn sort_header(bytes: &mut [u8]) {
    let (length, rest) = bytes.split_at_mut(HEADER_LENGTH);
    let length = u64::from_le_bytes((&*length).try_into().expect("eight bytes")) as usize;
    let header: serde_json::Value = serde_json::from_slice(&rest[..length]).expect("the header of a file");
    let sorted = header.to_string();
    // The header keeps its length, which includes padding with spaces.
    rest[..sorted.len()].copy_from_slice(sorted.as_bytes());
    rest[sorted.len()..length].fill(b' ');
}

/// Number of bytes of the header's length, at the start of a safetensors file.
const HEADER_LENGTH: usize = 8;

/// Writes a checkpoint in the format of torch.save atomically, with `weights` as its state dict and their metadata beside it. `torch.load`
/// and Lightning read it without any of our code.
///
/// # Errors
/// Returns an error if a tensor's type can't be stored, or if the file can't be written.
pub fn write_checkpoint(path: &Path, weights: &Weights) -> Result<()> {
    let contents = contents_of(&weights.tensors)?;
    torch_file::write_checkpoint(path, views(&weights.tensors, &contents)?, &weights.metadata)
}

/// Returns the bytes of each tensor, in row-major order.
fn contents_of(tensors: &BTreeMap<String, Tensor>) -> Result<Vec<Vec<u8>>> {
    let bytes = |tensor: &Tensor| {
        let tensor = tensor.detach().to_device(Device::Cpu).contiguous();
        let mut bytes = vec![0; tensor.numel() * to_dtype(tensor.kind())?.bitsize() / 8];
        tensor.f_copy_data_u8(&mut bytes, tensor.numel()).map_err(Error::external)?;
        Ok(bytes)
    };
    tensors.values().map(bytes).collect()
}

/// Returns the tensors, whose bytes are `contents`, with their types and shapes as they are stored.
fn views<'a>(
    tensors: &'a BTreeMap<String, Tensor>,
    contents: &'a [Vec<u8>],
) -> Result<Vec<(&'a str, TensorView<'a>)>> {
    let view = |((name, tensor), bytes): ((&'a String, &Tensor), &'a Vec<u8>)| {
        let shape = tensor.size().iter().map(|&side| side as usize).collect();
        let view = TensorView::new(to_dtype(tensor.kind())?, shape, bytes);
        Ok((name.as_str(), view.expect("the bytes of all elements")))
    };
    tensors.iter().zip(contents).map(view).collect()
}

/// Fills every variable of `vs` with `copy`, if the names and shapes are those of the tensors in `file`.
fn fit(
    vs: &nn::VarStore,
    shapes: &BTreeMap<&str, Vec<i64>>,
    file: &Path,
    copy: impl Fn(&str, &mut Tensor) -> Result<()>,
) -> Result<()> {
    let variables: BTreeMap<String, Tensor> = vs.variables().into_iter().collect();
    let mut misfits = vec![];
    for (name, variable) in &variables {
        match shapes.get(name.as_str()) {
            None => misfits.push((name.as_str(), "missing".to_string(), format!("{:?}", variable.size()))),
            Some(shape) if shape != &variable.size() => {
                misfits.push((name, format!("{shape:?}"), format!("{:?}", variable.size())));
            }
            Some(_) => {}
        }
    }
    for (name, shape) in shapes {
        if !variables.contains_key(*name) {
            misfits.push((name, format!("{shape:?}"), "no such tensor".to_string()));
        }
    }
    if let Some((name, found, expected)) = misfits.first() {
        let others = match misfits.len() - 1 {
            0 => String::new(),
            n => format!(" (and {n} more that don't fit)"),
        };
        return Err(Error::input(file, format!("tensor {name}"), found, format!("{expected}{others}")));
    }
    tch::no_grad(|| variables.into_iter().try_for_each(|(name, mut variable)| copy(&name, &mut variable)))
}

/// Reads a safetensors file of float32, bfloat16 or float16 tensors, or another format that [`WeightsFile::open`] supports.
///
/// # Errors
/// Returns the errors of [`WeightsFile::open`] and [`WeightsFile::read`].
pub fn read_weights(path: &Path) -> Result<Weights> {
    WeightsFile::open(path)?.read()
}

/// Returns `true` if `path` has an extension that is usual for weights.
pub fn is_weights_name(path: &Path) -> bool {
    let name = path.to_string_lossy().to_ascii_lowercase();
    let endings = [".safetensors", ".ckpt", ".pt", ".pth"];
    endings.iter().any(|ending| name.ends_with(ending))
}

/// Weights in a file, none of which have been read yet.
#[derive(Debug)]
pub struct WeightsFile {
    path: PathBuf,
    bytes: Bytes,
    arrays: BTreeMap<String, Array>,
    metadata: HashMap<String, String>,
}

/// Contents of a file: mapped, or embedded in the program.
#[derive(Debug)]
enum Bytes {
    Mapped(Mmap),
    Embedded(&'static [u8]),
}

impl Bytes {
    fn map(path: &Path) -> Result<Self> {
        let read = Error::read(path);
        let file = match File::open(path).and_then(|file| Ok((file.metadata()?.is_dir(), file))) {
            Ok((false, file)) => file,
            Ok((true, _)) => return Err(read(std::io::ErrorKind::IsADirectory.into())),
            Err(e) => return Err(read(e)),
        };
        // SAFETY: our own files are replaced as a whole, never changed in place. If another program truncates a file that is being read,
        // this process is killed.
        Ok(Bytes::Mapped(unsafe { MmapOptions::new().map_copy_read_only(&file) }.map_err(read)?))
    }

    fn get(&self) -> &[u8] {
        match self {
            Bytes::Mapped(map) => map,
            Bytes::Embedded(bytes) => bytes,
        }
    }
}

impl WeightsFile {
    /// Opens a safetensors file, or a file that torch.save wrote: a state dict, or a checkpoint with one. Nothing in a checkpoint is
    /// executed.
    ///
    /// # Errors
    /// Returns an error if the file can't be read, is damaged or has none of these formats, or if a tensor has a type that weights don't
    /// have.
    pub fn open(path: &Path) -> Result<Self> {
        Self::from_bytes(Bytes::map(path)?, path)
    }

    /// Opens weights that are embedded in the program; errors call them `path`.
    pub(crate) fn from_embedded(bytes: &'static [u8], path: &Path) -> Result<Self> {
        Self::from_bytes(Bytes::Embedded(bytes), path)
    }

    fn from_bytes(bytes: Bytes, path: &Path) -> Result<Self> {
        let (arrays, metadata) = match is_torch_file(bytes.get()) {
            true => state_dict(&TorchFile::parse(path, bytes.get())?, path)?,
            false => safetensors(bytes.get(), path)?,
        };
        Ok(WeightsFile { path: path.to_owned(), bytes, arrays, metadata })
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the file's `__metadata__`, or for a checkpoint the strings beside its state dict, and settings that shapes don't determine.
    pub fn metadata(&self) -> &HashMap<String, String> {
        &self.metadata
    }

    /// Returns the names of all tensors.
    pub fn names(&self) -> impl ExactSizeIterator<Item = &str> {
        self.arrays.keys().map(String::as_str)
    }

    /// Returns the type and shape of every tensor, by name.
    pub fn shapes(&self) -> BTreeMap<String, (Kind, Vec<i64>)> {
        let shape = |array: &Array| (to_kind(array.dtype), dimensions(&array.shape));
        self.arrays.iter().map(|(name, array)| (name.clone(), shape(array))).collect()
    }

    /// Renames every tensor with `rename`, and drops those for which it returns `None`.
    pub fn rename_tensors(self, rename: impl Fn(&str) -> Option<String>) -> Self {
        let arrays =
            self.arrays.into_iter().filter_map(|(name, array)| Some((rename(&name)?, array))).collect();
        WeightsFile { arrays, ..self }
    }

    /// Reads all weights into memory.
    ///
    /// # Errors
    /// Returns libtorch's error.
    pub fn read(&self) -> Result<Weights> {
        let tensors = self.arrays.iter().map(|(name, array)| Ok((name.clone(), self.tensor(array)?)));
        Ok(Weights { tensors: tensors.collect::<Result<_>>()?, metadata: self.metadata.clone() })
    }

    /// Copies the weights into the variables of `vs`, which keep their type and device.
    ///
    /// # Errors
    /// Returns an error if names, shapes or types don't match, before anything is copied: it reports the first name or shape and counts the
    /// others.
    pub fn load_into(&self, vs: &nn::VarStore) -> Result<()> {
        if let Some((name, array)) = self.arrays.iter().find(|(_, array)| !array.is_float()) {
            let field = format!("tensor {name}");
            return Err(Error::input(&self.path, field, array.dtype, "F32, BF16 or F16"));
        }
        let shapes = self.arrays.iter().map(|(name, a)| (name.as_str(), dimensions(&a.shape))).collect();
        fit(vs, &shapes, &self.path, |name, variable| {
            variable.f_copy_(&self.tensor(&self.arrays[name])?).map_err(Error::external)
        })
    }

    fn tensor(&self, array: &Array) -> Result<Tensor> {
        let bytes = &self.bytes.get()[array.bytes.clone()];
        let count = bytes.len() / (array.dtype.bitsize() / 8);
        let numbers = Tensor::f_from_data_size(bytes, &[count as i64], to_kind(array.dtype))
            .map_err(Error::external)?;
        numbers
            .f_as_strided(dimensions(&array.shape), dimensions(&array.strides), None)
            .map_err(Error::external)?
            .f_contiguous()
            .map_err(Error::external)
    }
}

fn dimensions(sizes: &[usize]) -> Vec<i64> {
    sizes.iter().map(|&size| size as i64).collect()
}

/// Returns the locations of the tensors of a safetensors file in its `bytes`.
fn safetensors(bytes: &[u8], path: &Path) -> Result<Contents> {
    let broken = |e: SafeTensorError| {
        Error::input(
            path,
            "the file",
            format!("broken ({e})"),
            "safetensors, or what torch.save writes since torch 1.6",
        )
    };
    let (header_length, header) = SafeTensors::read_metadata(bytes).map_err(broken)?;
    let mut arrays = BTreeMap::new();
    for (name, info) in header.tensors() {
        let dtype = info.dtype;
        if !matches!(dtype, Dtype::F32 | Dtype::F64 | Dtype::BF16 | Dtype::F16 | Dtype::I64) {
            return Err(Error::input(path, format!("tensor {name}"), dtype, "F32, BF16 or F16"));
        }
        let (from, to) = info.data_offsets;
        let start = HEADER_LENGTH + header_length;
        let shape = info.shape.clone();
        let strides = row_major(&shape);
        arrays.insert(name, Array { dtype, shape, strides, bytes: start + from..start + to });
    }
    Ok((arrays, header.metadata().clone().unwrap_or_default()))
}

/// Arrays by name, and metadata.
type Contents = (BTreeMap<String, Array>, HashMap<String, String>);

/// Keys under which a checkpoint may hold its state dict. Lightning uses the first.
const STATE_DICT_KEYS: [&str; 3] = ["state_dict", "model_state_dict", "model"];
/// Names of settings that the shapes of weights don't determine. A setting is used wherever it occurs in a checkpoint, if all occurrences
/// have the same value.
const SETTINGS: [&str; 1] = ["num_heads"];

/// Returns the tensors of the state dict in `file`, which was read from `path`. The metadata are the strings beside the state dict, and
/// settings.
fn state_dict(file: &TorchFile, path: &Path) -> Result<Contents> {
    let TorchFile { values, storages } = file;
    let refuse = |found: &str| {
        Err(Error::input(path, "the contents", found, "a state dict, or a checkpoint with a state_dict"))
    };
    let root = match values.get(values.root) {
        Value::Dict(items) => items,
        other => return refuse(other.type_name()),
    };
    let inner = STATE_DICT_KEYS.iter().find_map(|place| match values.find(root, place) {
        Some(Value::Dict(items)) => Some(items),
        _ => None,
    });
    let mut arrays = BTreeMap::new();
    for &(key, value) in inner.unwrap_or(root) {
        let (&Value::Str(name), tensor @ Value::Tensor { .. }) = (values.get(key), values.get(value)) else {
            continue;
        };
        let array = Array::locate(values, storages, tensor).map_err(|why| {
            Error::input(path, format!("tensor {name}"), format!("broken: it {why}"), "a whole one")
        })?;
        arrays.insert(name.to_string(), array);
    }
    if arrays.is_empty() {
        return refuse("a dict without tensors");
    }
    let mut metadata = HashMap::new();
    for &(key, value) in root {
        if let (&Value::Str(key), &Value::Str(text)) = (values.get(key), values.get(value)) {
            metadata.insert(key.to_string(), text.to_string());
        }
    }
    for setting in SETTINGS {
        let said = values.iter().filter_map(|value| match value {
            Value::Dict(items) | Value::Object(items) => values.find(items, setting),
            _ => None,
        });
        let said: BTreeSet<i64> = said.filter_map(Value::as_int).collect();
        if let (Some(number), 1) = (said.first(), said.len()) {
            metadata.insert(setting.to_string(), number.to_string());
        }
    }
    Ok((arrays, metadata))
}

/// Types that files and libtorch share.
const DTYPES: [(Dtype, Kind); 11] = [
    (Dtype::U8, Kind::Uint8),
    (Dtype::I8, Kind::Int8),
    (Dtype::I16, Kind::Int16),
    (Dtype::I32, Kind::Int),
    (Dtype::I64, Kind::Int64),
    (Dtype::F16, Kind::Half),
    (Dtype::BF16, Kind::BFloat16),
    (Dtype::F32, Kind::Float),
    (Dtype::F64, Kind::Double),
    (Dtype::BOOL, Kind::Bool),
    (Dtype::C64, Kind::ComplexFloat),
];

/// Returns libtorch's name of `dtype`.
fn to_kind(dtype: Dtype) -> Kind {
    DTYPES.iter().find(|(d, _)| *d == dtype).expect("every type").1
}

/// Returns the type of `kind` in a file.
fn to_dtype(kind: Kind) -> Result<Dtype> {
    let dtype = DTYPES.iter().find(|(_, k)| *k == kind).map(|(dtype, _)| *dtype);
    dtype.ok_or_else(|| Error::failed(format!("tensors of kind {kind:?} are not stored")))
}

/// Environment variable that names the folder of pretrained weights; if it is set, no other folder is searched.
pub const WEIGHTS_VARIABLE: &str = "GLOBALSPLAT_WEIGHTS";

/// Returns the folders that may contain pretrained weights, in order of preference.
pub fn pretrained_folders() -> Vec<PathBuf> {
    match std::env::var_os(WEIGHTS_VARIABLE) {
        Some(folder) => vec![folder.into()],
        None => vec!["weights".into(), concat!(env!("CARGO_MANIFEST_DIR"), "/weights").into()],
    }
}

/// Returns the file `name` in the first folder of pretrained weights that has it: the one that [`WEIGHTS_VARIABLE`] names, or else
/// `weights` in the current folder, or else the folder in which `make weights` put them when this program was built.
pub fn find_pretrained(name: &str) -> Option<PathBuf> {
    pretrained_folders().into_iter().map(|folder| folder.join(name)).find(|path| path.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_match_libtorch() {
        for (dtype, kind) in DTYPES {
            assert_eq!(dtype.bitsize(), 8 * kind.elt_size_in_bytes(), "{dtype}");
            assert_eq!((to_kind(dtype), to_dtype(kind).unwrap()), (kind, dtype));
        }
        assert!(to_dtype(Kind::ComplexHalf).is_err());
    }

    /// Every number of 16 bits, and numbers of 64 bits around the limits of float32 and between two of its values.
    #[test]
    fn numbers_are_rounded_as_by_libtorch() {
        let words: Vec<u8> = (0..=u16::MAX).flat_map(u16::to_le_bytes).collect();
        let mantissas = [0u64, 1, 0x1000_0000, 0x1000_0001, 0x2fff_ffff, 0x3000_0000, 0xf_ffff_f000_0000];
        let doubles: Vec<u8> = (0..4096u64)
            .flat_map(|top| mantissas.map(|mantissa| top << 52 | mantissa))
            .flat_map(u64::to_le_bytes)
            .collect();
        for (dtype, bytes) in [(Dtype::F16, &words), (Dtype::BF16, &words), (Dtype::F64, &doubles)] {
            let count = bytes.len() / (dtype.bitsize() / 8);
            let array = Array { dtype, shape: vec![count], strides: vec![1], bytes: 0..bytes.len() };
            let found = array.to_f32(bytes).unwrap();
            let tensor = Tensor::from_data_size(bytes, &[count as i64], to_kind(dtype));
            let expected = Vec::<f32>::try_from(tensor.to_kind(Kind::Float)).unwrap();
            for (found, expected) in found.into_iter().zip(expected) {
                assert_eq!(found.to_bits(), expected.to_bits(), "{dtype}: {found}, {expected}");
            }
        }
    }
}
