//! Weights as safetensors, with the configuration that rebuilds their model in the file's metadata.

use super::write_atomically;
use crate::error::{Error, Result};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use tch::{Device, Kind, Tensor, nn};

/// The contents of a safetensors file.
#[derive(Debug)]
pub struct Weights {
    /// By name, on the host, as stored.
    pub tensors: BTreeMap<String, Tensor>,
    /// The file's `__metadata__`.
    pub metadata: HashMap<String, String>,
}

/// Reads a safetensors file of float32, bfloat16 or float16 tensors.
///
/// # Errors
/// A file that can't be read, isn't safetensors, or holds another type.
pub fn read_weights(path: &Path) -> Result<Weights> {
    weights_from(&std::fs::read(path).map_err(Error::read(path))?, path)
}

/// As [`read_weights`], of a file's bytes; `path` is what errors call it.
pub(crate) fn weights_from(bytes: &[u8], path: &Path) -> Result<Weights> {
    let broken = |e: safetensors::SafeTensorError| {
        Error::input(path, "the file", format!("broken ({e})"), "safetensors")
    };
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(broken)?;
    let metadata = header.metadata().clone().unwrap_or_default();
    let file = SafeTensors::deserialize(bytes).map_err(broken)?;
    let mut tensors = BTreeMap::new();
    for (name, view) in file.iter() {
        let kind = match view.dtype() {
            Dtype::F32 => Kind::Float,
            Dtype::F64 => Kind::Double,
            Dtype::BF16 => Kind::BFloat16,
            Dtype::F16 => Kind::Half,
            Dtype::I64 => Kind::Int64,
            other => {
                return Err(Error::input(
                    path,
                    format!("tensor {name}"),
                    format!("{other:?}"),
                    "F32, BF16 or F16",
                ));
            }
        };
        let shape: Vec<i64> = view.shape().iter().map(|&s| s as i64).collect();
        tensors.insert(name.to_string(), Tensor::f_from_data_size(view.data(), &shape, kind)?);
    }
    Ok(Weights { tensors, metadata })
}

/// Writes a safetensors file, whole or not at all.
///
/// # Errors
/// The system's refusal to write.
pub fn write_weights(
    path: &Path,
    tensors: &BTreeMap<String, Tensor>,
    metadata: HashMap<String, String>,
) -> Result<()> {
    let stored = tensors.iter().map(|(name, t)| Ok((name, Stored::new(t)?))).collect::<Result<Vec<_>>>()?;
    let views = stored.iter().map(|(name, s)| Ok((name, s.view()?))).collect::<Result<Vec<_>>>()?;
    let failed = |e: &dyn std::fmt::Display| {
        Error::Failed(format!("{}: weights can't be serialized: {e}", path.display()))
    };
    let mut bytes = safetensors::serialize(views, Some(metadata)).map_err(|e| failed(&e))?;
    sort_header(&mut bytes).map_err(|e| failed(&e))?;
    write_atomically(path, |writer| writer.write_all(&bytes).map_err(Error::write(path)))
}

/// The metadata come in the order of a hash map, another one in each process: sorted, the same weights are the same bytes.
fn sort_header(bytes: &mut [u8]) -> serde_json::Result<()> {
    let (length, rest) = bytes.split_at_mut(8);
    let length = u64::from_le_bytes(length.try_into().expect("eight bytes")) as usize;
    let header: serde_json::Map<String, serde_json::Value> = serde_json::from_slice(&rest[..length])?;
    let sorted = serde_json::to_vec(&header)?;
    // What was padded with spaces stays so.
    rest[..sorted.len()].copy_from_slice(&sorted);
    rest[sorted.len()..length].fill(b' ');
    Ok(())
}

/// A tensor's bytes in row-major order.
struct Stored {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

impl Stored {
    fn new(tensor: &Tensor) -> Result<Self> {
        let tensor = tensor.detach().to_device(Device::Cpu).contiguous();
        let dtype = match tensor.kind() {
            Kind::Float => Dtype::F32,
            Kind::BFloat16 => Dtype::BF16,
            Kind::Int64 => Dtype::I64,
            other => return Err(Error::Failed(format!("tensors of kind {other:?} are not stored"))),
        };
        let mut bytes = vec![0; tensor.numel() * tensor.kind().elt_size_in_bytes()];
        tensor.f_copy_data_u8(&mut bytes, tensor.numel())?;
        let shape = tensor.size().iter().map(|&s| s as usize).collect();
        Ok(Stored { dtype, shape, bytes })
    }

    fn view(&self) -> Result<TensorView<'_>> {
        TensorView::new(self.dtype, self.shape.clone(), &self.bytes)
            .map_err(|e| Error::Failed(format!("weights can't be serialized: {e}")))
    }
}

impl Weights {
    /// Copies the weights into the variables of `vs`, which keep their type and device.
    ///
    /// # Errors
    /// Names or shapes that don't fit, before anything is copied: the first is named and the rest counted.
    pub fn load_into(&self, vs: &nn::VarStore, file: &Path) -> Result<()> {
        let variables: BTreeMap<String, Tensor> = vs.variables().into_iter().collect();
        let mut misfits = vec![];
        for (name, variable) in &variables {
            match self.tensors.get(name) {
                None => misfits.push((name, "absent".to_string(), format!("{:?}", variable.size()))),
                Some(t) if t.size() != variable.size() => {
                    misfits.push((name, format!("{:?}", t.size()), format!("{:?}", variable.size())));
                }
                Some(_) => {}
            }
        }
        for (name, t) in &self.tensors {
            if !variables.contains_key(name) {
                misfits.push((name, format!("{:?}", t.size()), "no such tensor".to_string()));
            }
        }
        if let Some((name, found, expected)) = misfits.first() {
            let others = match misfits.len() - 1 {
                0 => String::new(),
                n => format!(" (and {n} more that don't fit)"),
            };
            return Err(Error::input(file, format!("tensor {name}"), found, format!("{expected}{others}")));
        }
        tch::no_grad(|| {
            for (name, mut variable) in variables {
                variable.copy_(&self.tensors[&name]);
            }
        });
        Ok(())
    }
}
