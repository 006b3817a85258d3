//! Weights in safetensors files, whose metadata hold the configuration that rebuilds their model, and in checkpoints.

use super::dtype::to_dtype;
use crate::error::{Error, Result};
use globalsplat_files::{PartialFile, write_temporary};
use globalsplat_torch_file as torch_file;
use globalsplat_torch_file::Dtype;
use safetensors::tensor::TensorView;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use tch::{Device, Tensor, nn};

/// Contents of a safetensors file.
#[derive(Debug)]
pub struct Weights {
    /// Tensors by name, on the host, in their stored type.
    pub tensors: BTreeMap<String, Tensor>,
    /// Metadata of the file, its `__metadata__`.
    pub metadata: HashMap<String, String>,
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
    Ok(write_weights_partially(path, tensors, metadata)?.persist()?)
}

/// Writes a file like [`write_weights`], but leaves it under its temporary name until [`PartialFile::persist`] is called.
///
/// # Errors
/// Returns the errors of [`write_weights`].
pub(super) fn write_weights_partially(
    path: &Path,
    tensors: &BTreeMap<String, Tensor>,
    metadata: HashMap<String, String>,
) -> Result<PartialFile> {
    let stored = Stored::all(tensors)?;
    let views = stored.iter().map(|(name, s)| Ok((name, s.view()?))).collect::<Result<Vec<_>>>()?;
    let failed = |e: &dyn std::fmt::Display| {
        Error::failed(format!("{}: weights can't be serialized: {e}", path.display()))
    };
    let mut bytes = safetensors::serialize(views, Some(metadata)).map_err(|e| failed(&e))?;
    sort_header(&mut bytes).map_err(|e| failed(&e))?;
    let (header, tensors) = bytes.split_at(8 + header_length(&bytes));
    let padding = header.len().next_multiple_of(ALIGNMENT) - header.len();
    let length = (header.len() - 8 + padding) as u64;
    write_temporary(path, |writer| {
        let parts = [&length.to_le_bytes(), &header[8..], &[b' '; ALIGNMENT][..padding], tensors];
        parts.into_iter().try_for_each(|part| writer.write_all(part)).map_err(Error::write(path))
    })
}

/// Writes a checkpoint in the format of torch.save atomically, with `weights` as its state dict and their metadata beside it. `torch.load`
/// and Lightning read it without any of our code.
///
/// # Errors
/// Returns an error if a tensor's type can't be stored, or if the file can't be written.
pub fn write_checkpoint(path: &Path, weights: &Weights) -> Result<()> {
    let stored = Stored::all(&weights.tensors)?;
    let tensors: Vec<_> = stored
        .iter()
        .map(|(name, s)| torch_file::TensorView { name, dtype: s.dtype, shape: &s.shape, bytes: &s.bytes })
        .collect();
    Ok(torch_file::write_checkpoint(path, &tensors, &weights.metadata)?)
}

/// Alignment of the tensors' bytes in a file. Kernels of libtorch round differently where a mapped file's values aren't aligned to 16
/// bytes.
const ALIGNMENT: usize = 64;

/// Returns the length of the header, which follows the eight bytes that hold it.
fn header_length(bytes: &[u8]) -> usize {
    u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes")) as usize
}

/// Sorts the metadata in the header. They come in the order of a hash map, which differs between processes; sorted, equal weights give
/// equal bytes.
fn sort_header(bytes: &mut [u8]) -> serde_json::Result<()> {
    let length = header_length(bytes);
    let rest = &mut bytes[8..];
    let header: serde_json::Map<String, serde_json::Value> = serde_json::from_slice(&rest[..length])?;
    let sorted = serde_json::to_vec(&header)?;
    // The header keeps its length, which includes padding with spaces.
    rest[..sorted.len()].copy_from_slice(&sorted);
    rest[sorted.len()..length].fill(b' ');
    Ok(())
}

/// A tensor's bytes in row-major order, with its type and shape.
struct Stored {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

impl Stored {
    fn all(tensors: &BTreeMap<String, Tensor>) -> Result<Vec<(&str, Self)>> {
        tensors.iter().map(|(name, tensor)| Ok((name.as_str(), Stored::new(tensor)?))).collect()
    }

    fn new(tensor: &Tensor) -> Result<Self> {
        let tensor = tensor.detach().to_device(Device::Cpu).contiguous();
        let dtype = to_dtype(tensor.kind())?;
        let mut bytes = vec![0; tensor.numel() * dtype.size()];
        tensor.f_copy_data_u8(&mut bytes, tensor.numel())?;
        let shape = tensor.size().iter().map(|&s| s as usize).collect();
        Ok(Stored { dtype, shape, bytes })
    }

    fn view(&self) -> Result<TensorView<'_>> {
        let dtype = match self.dtype {
            Dtype::F32 => safetensors::Dtype::F32,
            Dtype::BF16 => safetensors::Dtype::BF16,
            Dtype::I64 => safetensors::Dtype::I64,
            other => return Err(Error::failed(format!("tensors of type {other} are not stored"))),
        };
        TensorView::new(dtype, self.shape.clone(), &self.bytes)
            .map_err(Error::failed_with_context("weights can't be serialized"))
    }
}

impl Weights {
    /// Copies the weights into the variables of `vs`, which keep their type and device.
    ///
    /// # Errors
    /// Returns an error if names or shapes don't match, before anything is copied: it names the first mismatch and counts the others.
    pub fn load_into(&self, vs: &nn::VarStore, file: &Path) -> Result<()> {
        let shapes = self.tensors.iter().map(|(name, t)| (name.as_str(), t.size())).collect();
        fit(vs, &shapes, file, |name, variable| Ok(variable.f_copy_(&self.tensors[name])?))
    }
}

/// Fills every variable of `vs` with `copy`, if the names and shapes are those of the tensors in `file`.
pub(super) fn fit(
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

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Kind;

    #[test]
    fn tensors_are_aligned_whatever_the_metadata() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let file = folder.path().join("a.safetensors");
        let tensors = BTreeMap::from([("a".to_string(), Tensor::arange(5, (Kind::Float, Device::Cpu)))]);
        for length in 0..70 {
            let metadata = HashMap::from([("text".to_string(), "x".repeat(length))]);
            write_weights(&file, &tensors, metadata).expect("a file");
            let bytes = std::fs::read(&file).expect("a file");
            assert_eq!((8 + header_length(&bytes)) % ALIGNMENT, 0, "{length}");
            let read = safetensors::SafeTensors::deserialize(&bytes).expect("safetensors");
            assert_eq!(read.tensor("a").expect("a tensor").data()[4..8], 1f32.to_le_bytes());
        }
    }
}
