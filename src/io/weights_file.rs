//! Weights where they lie on disk: in one safetensors file, in several with an index, or in a checkpoint that torch.save wrote. The
//! files are mapped, so a tensor is read when it is asked for, once, and straight to where it belongs.

use super::state_dict::{Contents, state_dict};
use super::torch_file::{Array, TorchFile, row_major};
use super::weights::{Weights, fit};
use crate::error::{Error, Result};
use memmap2::{Mmap, UncheckedAdvice};
use safetensors::{Dtype, SafeTensorError, SafeTensors};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};
use tch::{Device, Kind, Tensor, nn};

/// How the name of an index of shards ends, as Hugging Face's libraries write it.
pub(super) const INDEX_ENDING: &str = ".safetensors.index.json";
/// That file.
#[derive(Serialize, Deserialize)]
pub(super) struct ShardIndex {
    #[serde(default)]
    pub metadata: serde_json::Map<String, serde_json::Value>,
    /// In which file, beside the index, each tensor is.
    pub weight_map: BTreeMap<String, String>,
}

/// Reads a safetensors file of float32, bfloat16 or float16 tensors, or whatever else [`WeightsFile::open`] knows.
///
/// # Errors
/// As there.
pub fn read_weights(path: &Path) -> Result<Weights> {
    WeightsFile::open(path)?.read()
}

/// Whether files of this name hold weights, as a rule.
pub fn is_weights_name(path: &Path) -> bool {
    let ending = path.extension().and_then(|ending| ending.to_str());
    path.to_string_lossy().ends_with(INDEX_ENDING)
        || matches!(ending, Some("safetensors" | "ckpt" | "pt" | "pth"))
}

/// Weights in one file or several, none of them read yet.
#[derive(Debug)]
pub struct WeightsFile {
    path: PathBuf,
    parts: Vec<Bytes>,
    tensors: BTreeMap<String, Place>,
    metadata: HashMap<String, String>,
}

/// A file's contents.
#[derive(Debug)]
enum Bytes {
    Mapped(Mmap),
    /// By the program itself.
    Carried(&'static [u8]),
}

impl Bytes {
    fn map(path: &Path) -> Result<Self> {
        let read = Error::read(path);
        let file = match File::open(path).and_then(|file| Ok((file.metadata()?.is_dir(), file))) {
            Ok((false, file)) => file,
            Ok((true, _)) => return Err(read(std::io::ErrorKind::IsADirectory.into())),
            Err(e) => return Err(read(e)),
        };
        // SAFETY: ours are replaced as a whole, never changed in place. Whoever cuts off a file that is being read ends the program.
        Ok(Bytes::Mapped(unsafe { Mmap::map(&file) }.map_err(read)?))
    }

    fn get(&self) -> &[u8] {
        match self {
            Bytes::Mapped(map) => map,
            Bytes::Carried(bytes) => bytes,
        }
    }

    /// Says that nobody needs them again soon: a mapped file's pages don't stay beside what was copied from them.
    fn let_go(&self, range: Range<usize>) {
        if let Bytes::Mapped(map) = self {
            // SAFETY: pages of a file that was mapped to be read; whoever reads them again gets the same.
            let advised =
                unsafe { map.unchecked_advise_range(UncheckedAdvice::DontNeed, range.start, range.len()) };
            // It is advice alone.
            let _ = advised;
        }
    }
}

/// A tensor's place in one of the files.
#[derive(Debug)]
struct Place {
    part: usize,
    array: Array,
}

impl WeightsFile {
    /// Looks into a safetensors file, an index of such files (`*.safetensors.index.json`), or what torch.save wrote: a state dict, or
    /// a checkpoint with one. Of a checkpoint nothing is run.
    ///
    /// # Errors
    /// A file that can't be read, is damaged or is none of these, or has tensors of a type that no weights have.
    pub fn open(path: &Path) -> Result<Self> {
        if path.to_string_lossy().ends_with(INDEX_ENDING) {
            return Self::open_shards(path);
        }
        // The name that shards were written under.
        let index = path.with_extension(INDEX_ENDING.trim_start_matches('.'));
        if !path.exists() && path.extension().is_some_and(|ending| ending == "safetensors") && index.exists()
        {
            return Self::open_shards(&index);
        }
        Self::of(Bytes::map(path)?, path)
    }

    /// What the program carries; `path` is what errors call it.
    pub(crate) fn carried(bytes: &'static [u8], path: &Path) -> Result<Self> {
        Self::of(Bytes::Carried(bytes), path)
    }

    fn of(bytes: Bytes, path: &Path) -> Result<Self> {
        let (arrays, metadata) = match TorchFile::is_one(bytes.get()) {
            true => state_dict(&TorchFile::parse(path, bytes.get())?, path)?,
            false => safetensors(bytes.get(), path)?,
        };
        let tensors = arrays.into_iter().map(|(name, array)| (name, Place { part: 0, array })).collect();
        Ok(WeightsFile { path: path.to_owned(), parts: vec![bytes], tensors, metadata })
    }

    fn open_shards(path: &Path) -> Result<Self> {
        let text = std::fs::read(path).map_err(Error::read(path))?;
        let index: ShardIndex = serde_json::from_slice(&text)
            .map_err(|e| Error::input(path, "the index", format!("broken ({e})"), "a weight_map of names"))?;
        let mut names: Vec<&String> = index.weight_map.values().collect();
        names.sort();
        names.dedup();
        let (mut parts, mut tensors, mut metadata) = (vec![], BTreeMap::new(), HashMap::new());
        for name in names {
            if Path::new(name).components().count() != 1 || name.starts_with('.') {
                return Err(Error::input(path, "weight_map", name, "the name of a file beside the index"));
            }
            let file = path.with_file_name(name);
            let bytes = Bytes::map(&file)?;
            let (arrays, described) = safetensors(bytes.get(), &file)?;
            for (tensor, array) in arrays.into_iter().filter(|(t, _)| index.weight_map.get(t) == Some(name)) {
                tensors.insert(tensor, Place { part: parts.len(), array });
            }
            metadata.extend(described);
            parts.push(bytes);
        }
        match index.weight_map.iter().find(|(tensor, _)| !tensors.contains_key(*tensor)) {
            Some((tensor, name)) => {
                let file = path.with_file_name(name);
                Err(Error::input(&file, format!("tensor {tensor}"), "absent", "what the index says"))
            }
            None => Ok(WeightsFile { path: path.to_owned(), parts, tensors, metadata }),
        }
    }

    /// The file, or the index of files.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The file's `__metadata__`; of a checkpoint the strings beside its state dict, and settings that shapes don't tell.
    pub fn metadata(&self) -> &HashMap<String, String> {
        &self.metadata
    }

    /// Every tensor's name.
    pub fn names(&self) -> impl ExactSizeIterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// Every tensor's type and shape, by its name.
    pub fn shapes(&self) -> BTreeMap<String, (Kind, Vec<i64>)> {
        self.tensors
            .iter()
            .map(|(name, s)| (name.clone(), (s.array.dtype, dimensions(&s.array.size))))
            .collect()
    }

    /// Calls every tensor as `rename` says, and leaves out those of which it says nothing.
    pub fn renamed(self, rename: impl Fn(&str) -> Option<String>) -> Self {
        let tensors = self.tensors.into_iter().filter_map(|(name, s)| Some((rename(&name)?, s))).collect();
        WeightsFile { tensors, ..self }
    }

    /// All of it, in memory.
    ///
    /// # Errors
    /// libtorch's refusal.
    pub fn read(&self) -> Result<Weights> {
        let tensors = self.tensors.iter().map(|(name, place)| Ok((name.clone(), self.copy(place)?)));
        Ok(Weights { tensors: tensors.collect::<Result<_>>()?, metadata: self.metadata.clone() })
    }

    /// Copies the weights into the variables of `vs`, which keep their type and device.
    ///
    /// # Errors
    /// Names, shapes or types that don't fit, before anything is copied: the first name or shape is told and the rest counted.
    pub fn load_into(&self, vs: &nn::VarStore) -> Result<()> {
        let is_weight = |kind| matches!(kind, Kind::Float | Kind::Double | Kind::BFloat16 | Kind::Half);
        if let Some((name, place)) = self.tensors.iter().find(|(_, place)| !is_weight(place.array.dtype)) {
            let (field, found) = (format!("tensor {name}"), format!("{:?}", place.array.dtype));
            return Err(Error::input(&self.path, field, found, "F32, BF16 or F16"));
        }
        let shapes =
            self.tensors.iter().map(|(name, s)| (name.as_str(), dimensions(&s.array.size))).collect();
        fit(vs, &shapes, &self.path, |name, variable| {
            let place = &self.tensors[name];
            let Array { dtype, size, stride, bytes } = &place.array;
            let part = &self.parts[place.part].get()[bytes.clone()];
            match part.as_ptr().align_offset(dtype.elt_size_in_bytes()) {
                0 if !part.is_empty() => {
                    // SAFETY: the array lies inside the file, which stays mapped until it is copied.
                    let view = unsafe {
                        let (size, stride) = (dimensions(size), dimensions(stride));
                        Tensor::f_from_blob(part.as_ptr(), &size, &stride, *dtype, Device::Cpu)?
                    };
                    variable.f_copy_(&view)?;
                }
                _ => variable.f_copy_(&self.copy(place)?)?,
            }
            self.parts[place.part].let_go(bytes.clone());
            Ok(())
        })
    }

    fn copy(&self, Place { part, array }: &Place) -> Result<Tensor> {
        let bytes = &self.parts[*part].get()[array.bytes.clone()];
        let count = bytes.len() / array.dtype.elt_size_in_bytes();
        let numbers = Tensor::f_from_data_size(bytes, &[count as i64], array.dtype)?;
        Ok(numbers.f_as_strided(dimensions(&array.size), dimensions(&array.stride), None)?.f_contiguous()?)
    }
}

fn dimensions(sizes: &[usize]) -> Vec<i64> {
    sizes.iter().map(|&size| size as i64).collect()
}

/// Where the tensors of a safetensors file lie in its `bytes`.
fn safetensors(bytes: &[u8], path: &Path) -> Result<Contents> {
    let broken = |e: SafeTensorError| {
        Error::input(path, "the file", format!("broken ({e})"), "safetensors, or what torch.save writes")
    };
    let (header_length, header) = SafeTensors::read_metadata(bytes).map_err(broken)?;
    /// Of the header's length.
    const LENGTH: usize = 8;
    let mut arrays = BTreeMap::new();
    for (name, info) in header.tensors() {
        let dtype = match info.dtype {
            Dtype::F32 => Kind::Float,
            Dtype::F64 => Kind::Double,
            Dtype::BF16 => Kind::BFloat16,
            Dtype::F16 => Kind::Half,
            Dtype::I64 => Kind::Int64,
            other => {
                let (field, found) = (format!("tensor {name}"), format!("{other:?}"));
                return Err(Error::input(path, field, found, "F32, BF16 or F16"));
            }
        };
        let (from, to) = info.data_offsets;
        let start = LENGTH + header_length;
        let size = info.shape.clone();
        let stride = row_major(&size);
        arrays.insert(name, Array { dtype, size, stride, bytes: start + from..start + to });
    }
    Ok((arrays, header.metadata().clone().unwrap_or_default()))
}
