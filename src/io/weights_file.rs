//! Memory-mapped weights: one safetensors file, several with an index, or a checkpoint that torch.save wrote. A tensor is read when it is
//! needed, once, and directly into its destination.

use super::dtype::to_kind;
use super::state_dict::{Contents, state_dict};
use super::weights::{Weights, fit};
use crate::error::{Error, Result};
use globalsplat_files::read_text;
use globalsplat_torch_file::{Array, Dtype, TorchFile, is_torch_file, row_major};
use memmap2::{Mmap, MmapMut, MmapOptions, UncheckedAdvice};
use safetensors::{SafeTensorError, SafeTensors};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};
use tch::{Device, Kind, Tensor, nn};

/// Suffix of the name of an index of shards, as Hugging Face's libraries write it.
pub(super) const INDEX_ENDING: &str = ".safetensors.index.json";
/// Contents of an index of shards.
#[derive(Serialize, Deserialize)]
pub(super) struct ShardIndex {
    #[serde(default)]
    pub metadata: serde_json::Map<String, serde_json::Value>,
    /// File, beside the index, that contains each tensor.
    pub weight_map: BTreeMap<String, String>,
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
    let endings = [INDEX_ENDING, ".safetensors", ".ckpt", ".pt", ".pth"];
    endings.iter().any(|ending| name.ends_with(ending))
}

/// Returns the files that [`WeightsFile::open`] reads at `path`: one file, or an index and the files that it names.
pub fn weights_files(path: &Path) -> Vec<PathBuf> {
    let Some(index) = index_at(path) else { return vec![path.to_owned()] };
    let shards = read_index(&index).map(|index| index.weight_map.into_values().collect::<BTreeSet<_>>());
    let shards = shards.unwrap_or_default().into_iter().map(|name| index.with_file_name(name));
    std::iter::once(index.clone()).chain(shards).collect()
}

/// Returns the index of shards that `path` is, or that takes the place of a missing file at `path`.
fn index_at(path: &Path) -> Option<PathBuf> {
    let ends_in = |ending: &str| path.to_string_lossy().to_ascii_lowercase().ends_with(ending);
    if ends_in(INDEX_ENDING) {
        return Some(path.to_owned());
    }
    // `path` may be the name from which the names of the shards were derived.
    let index = path.with_extension(INDEX_ENDING.trim_start_matches('.'));
    (!path.exists() && ends_in(".safetensors") && index.exists()).then_some(index)
}

fn read_index(path: &Path) -> Result<ShardIndex> {
    serde_json::from_str(&read_text(path)?)
        .map_err(|e| Error::input(path, "the index", format!("broken ({e})"), "a weight_map of names"))
}

/// Weights in one or several files, none of which have been read yet.
#[derive(Debug)]
pub struct WeightsFile {
    path: PathBuf,
    /// The index, if there is one, and the files with tensors.
    files: Vec<PathBuf>,
    shards: Vec<Bytes>,
    tensors: BTreeMap<String, TensorLocation>,
    metadata: HashMap<String, String>,
}

/// Contents of a file.
#[derive(Debug)]
enum Bytes {
    Mapped(Mmap),
    /// Copy-on-write mapping: what is written there is private to the process.
    Private(MmapMut),
    /// Bytes embedded in the program.
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
            Bytes::Private(map) => map,
            Bytes::Embedded(bytes) => bytes,
        }
    }

    /// Makes a mapping copy-on-write.
    fn make_private(self, path: &Path) -> Result<Self> {
        match self {
            Bytes::Mapped(map) => Ok(Bytes::Private(map.make_mut().map_err(Error::read(path))?)),
            other => Ok(other),
        }
    }

    /// Advises the system that these pages aren't needed soon, so that pages of a mapped file don't stay in memory beside what was copied
    /// from them. A later access reads them from the file again.
    fn release_pages(&self, range: Range<usize>) {
        let (start, length) = (range.start, range.len());
        // SAFETY: these are pages of a file, which are only read as numbers, for which every value is valid.
        let advised = unsafe {
            match self {
                Bytes::Mapped(map) => map.unchecked_advise_range(UncheckedAdvice::DontNeed, start, length),
                Bytes::Private(map) => map.unchecked_advise_range(UncheckedAdvice::DontNeed, start, length),
                Bytes::Embedded(_) => Ok(()),
            }
        };
        // An error is ignored: this is only advice.
        let _ = advised;
    }
}

/// Location of a tensor in one of the files.
#[derive(Debug)]
struct TensorLocation {
    shard: usize,
    array: Array,
}

impl WeightsFile {
    /// Opens a safetensors file, an index of such files (`*.safetensors.index.json`), or a file that torch.save wrote: a state dict, or a
    /// checkpoint with one. Nothing in a checkpoint is executed.
    ///
    /// # Errors
    /// Returns an error if a file can't be read, is damaged or has none of these formats, or if a tensor has a type that weights don't
    /// have.
    pub fn open(path: &Path) -> Result<Self> {
        match index_at(path) {
            Some(index) => Self::open_shards(&index),
            None => Self::from_bytes(Bytes::map(path)?, path),
        }
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
        let tensors =
            arrays.into_iter().map(|(name, array)| (name, TensorLocation { shard: 0, array })).collect();
        let path = path.to_owned();
        Ok(WeightsFile { files: vec![path.clone()], path, shards: vec![bytes], tensors, metadata })
    }

    fn open_shards(path: &Path) -> Result<Self> {
        let index = read_index(path)?;
        let mut names: Vec<&String> = index.weight_map.values().collect();
        names.sort();
        names.dedup();
        let (mut shards, mut tensors, mut metadata) = (vec![], BTreeMap::new(), HashMap::new());
        let mut files = vec![path.to_owned()];
        for name in names {
            if Path::new(name).components().count() != 1 || name.starts_with('.') {
                return Err(Error::input(
                    path,
                    "weight_map",
                    name,
                    "the name of a file in the folder of the index",
                ));
            }
            let file = path.with_file_name(name);
            let bytes = Bytes::map(&file)?;
            let (arrays, described) = safetensors(bytes.get(), &file)?;
            for (tensor, array) in arrays.into_iter().filter(|(t, _)| index.weight_map.get(t) == Some(name)) {
                tensors.insert(tensor, TensorLocation { shard: shards.len(), array });
            }
            metadata.extend(described);
            shards.push(bytes);
            files.push(file);
        }
        match index.weight_map.iter().find(|(tensor, _)| !tensors.contains_key(*tensor)) {
            Some((tensor, name)) => {
                let file = path.with_file_name(name);
                Err(Error::input(&file, format!("tensor {tensor}"), "missing", "what the index says"))
            }
            None => Ok(WeightsFile { path: path.to_owned(), files, shards, tensors, metadata }),
        }
    }

    /// Returns the path of the file, or of the index of files.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the files that hold the weights: one file, or an index and the shards that it names.
    pub fn files(&self) -> &[PathBuf] {
        &self.files
    }

    /// Returns the file's `__metadata__`, or for a checkpoint the strings beside its state dict, and settings that shapes don't determine.
    pub fn metadata(&self) -> &HashMap<String, String> {
        &self.metadata
    }

    /// Returns the names of all tensors.
    pub fn names(&self) -> impl ExactSizeIterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// Returns the type and shape of every tensor, by name.
    pub fn shapes(&self) -> BTreeMap<String, (Kind, Vec<i64>)> {
        self.tensors
            .iter()
            .map(|(name, s)| (name.clone(), (to_kind(s.array.dtype), dimensions(&s.array.shape))))
            .collect()
    }

    /// Renames every tensor with `rename`, and drops those for which it returns `None`.
    pub fn rename_tensors(self, rename: impl Fn(&str) -> Option<String>) -> Self {
        let tensors = self.tensors.into_iter().filter_map(|(name, s)| Some((rename(&name)?, s))).collect();
        WeightsFile { tensors, ..self }
    }

    /// Reads all weights into memory.
    ///
    /// # Errors
    /// Returns libtorch's error.
    pub fn read(&self) -> Result<Weights> {
        let tensors = self.tensors.iter().map(|(name, place)| Ok((name.clone(), self.copy(place)?)));
        Ok(Weights { tensors: tensors.collect::<Result<_>>()?, metadata: self.metadata.clone() })
    }

    /// Copies the weights into the variables of `vs`, which keep their type and device.
    ///
    /// # Errors
    /// Returns an error if names, shapes or types don't match, before anything is copied: it reports the first name or shape and counts the
    /// others.
    pub fn load_into(&self, vs: &nn::VarStore) -> Result<()> {
        self.fill(vs, |_, _| false)
    }

    /// Loads the weights like [`WeightsFile::load_into`], but doesn't copy weights that variables on the host can use as they are: from now
    /// on the data of these variables stay in the mapped file, and only pages in use take memory. Writing to a variable creates a private
    /// copy of the page.
    ///
    /// # Errors
    /// Returns the errors of [`WeightsFile::load_into`], and an error if a file can't be mapped.
    pub fn load_mmap(mut self, vs: &nn::VarStore) -> Result<MappedWeights> {
        let path = &self.path;
        self.shards = self.shards.into_iter().map(|bytes| bytes.make_private(path)).collect::<Result<_>>()?;
        let are_files = self.shards.iter().all(|bytes| matches!(bytes, Bytes::Private(_)));
        let takes = |variable: &Tensor, view: &Tensor| {
            variable.device() == Device::Cpu && variable.kind() == view.kind() && view.is_contiguous()
        };
        self.fill(vs, |variable, view| are_files && takes(variable, view))?;
        // The files stay mapped, because nothing limits how long the variables live.
        Ok(MappedWeights(Box::leak(self.shards.into_boxed_slice())))
    }

    /// Fills the variables of `vs`. If `lies_in_file` returns `true` for a variable and the view of its weights in the file, the variable
    /// takes the view; the others get a copy.
    fn fill(&self, vs: &nn::VarStore, lies_in_file: impl Fn(&Tensor, &Tensor) -> bool) -> Result<()> {
        if let Some((name, place)) = self.tensors.iter().find(|(_, place)| !place.array.dtype.is_float()) {
            let field = format!("tensor {name}");
            return Err(Error::input(&self.path, field, place.array.dtype, "F32, BF16 or F16"));
        }
        let shapes =
            self.tensors.iter().map(|(name, s)| (name.as_str(), dimensions(&s.array.shape))).collect();
        fit(vs, &shapes, &self.path, |name, variable| {
            let place = &self.tensors[name];
            let Array { dtype, shape, strides, bytes } = &place.array;
            let shard = &self.shards[place.shard].get()[bytes.clone()];
            match shard.as_ptr().align_offset(dtype.size()) {
                0 if !shard.is_empty() => {
                    // SAFETY: the array lies inside the file, which stays mapped until the array is copied, or else forever.
                    let view = unsafe {
                        let (size, stride) = (dimensions(shape), dimensions(strides));
                        Tensor::f_from_blob(shard.as_ptr(), &size, &stride, to_kind(*dtype), Device::Cpu)?
                    };
                    if lies_in_file(variable, &view) {
                        variable.set_data(&view);
                        return Ok(());
                    }
                    variable.f_copy_(&view)?;
                }
                _ => variable.f_copy_(&self.copy(place)?)?,
            }
            self.shards[place.shard].release_pages(bytes.clone());
            Ok(())
        })
    }

    fn copy(&self, TensorLocation { shard, array }: &TensorLocation) -> Result<Tensor> {
        let bytes = &self.shards[*shard].get()[array.bytes.clone()];
        let count = bytes.len() / array.dtype.size();
        let numbers = Tensor::f_from_data_size(bytes, &[count as i64], to_kind(array.dtype))?;
        Ok(numbers
            .f_as_strided(dimensions(&array.shape), dimensions(&array.strides), None)?
            .f_contiguous()?)
    }
}

/// Mapped files that hold the data of variables ([`WeightsFile::load_mmap`]), for the rest of the process.
#[derive(Debug, Clone, Copy)]
pub struct MappedWeights(&'static [Bytes]);

impl MappedWeights {
    /// Releases the memory of pages that were read, until they are read again, usually from the system's page cache. Values that were
    /// written to these variables are lost.
    pub fn release_pages(&self) {
        self.0.iter().for_each(|bytes| bytes.release_pages(0..bytes.get().len()));
    }
}

fn dimensions(sizes: &[usize]) -> Vec<i64> {
    sizes.iter().map(|&size| size as i64).collect()
}

/// Returns the locations of the tensors of a safetensors file in its `bytes`.
fn safetensors(bytes: &[u8], path: &Path) -> Result<Contents> {
    let broken = |e: SafeTensorError| {
        Error::input(path, "the file", format!("broken ({e})"), "safetensors, or what torch.save writes")
    };
    let (header_length, header) = SafeTensors::read_metadata(bytes).map_err(broken)?;
    /// Number of bytes of the header's length.
    const LENGTH: usize = 8;
    let mut arrays = BTreeMap::new();
    for (name, info) in header.tensors() {
        let dtype = match info.dtype {
            safetensors::Dtype::F32 => Dtype::F32,
            safetensors::Dtype::F64 => Dtype::F64,
            safetensors::Dtype::BF16 => Dtype::BF16,
            safetensors::Dtype::F16 => Dtype::F16,
            safetensors::Dtype::I64 => Dtype::I64,
            other => {
                let (field, found) = (format!("tensor {name}"), format!("{other:?}"));
                return Err(Error::input(path, field, found, "F32, BF16 or F16"));
            }
        };
        let (from, to) = info.data_offsets;
        let start = LENGTH + header_length;
        let shape = info.shape.clone();
        let strides = row_major(&shape);
        arrays.insert(name, Array { dtype, shape, strides, bytes: start + from..start + to });
    }
    Ok((arrays, header.metadata().clone().unwrap_or_default()))
}
