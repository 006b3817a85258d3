//! Tensors in `.npz` files, which numpy reads and writes.

use crate::error::{Error, Result};
use ndarray::ArrayD;
use npyz::npz::{NpzArchive, NpzWriter};
use npyz::{DType, Deserialize, NpyFile, WriterBuilder};
use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;
use tch::kind::Element;
use tch::{Kind, Tensor};

/// Tensors by array name.
pub type Arrays = BTreeMap<String, Tensor>;

/// Reads float32, float64, int64 and uint8 arrays in C order.
pub fn read_npz(path: &Path) -> Result<Arrays> {
    let mut archive = NpzArchive::open(path).map_err(Error::read(path))?;
    let names: Vec<String> = archive.array_names().map(String::from).collect();
    let mut arrays = Arrays::new();
    for name in names {
        let array = archive.by_name(&name).map_err(Error::read(path))?.expect("a name that the archive gave");
        let descr = match array.dtype() {
            DType::Plain(descr) => descr.to_string(),
            other => format!("{other:?}"),
        };
        let tensor = match descr.trim_start_matches(['<', '|', '=']) {
            "f4" => tensor_of::<f32>(array),
            "f8" => tensor_of::<f64>(array),
            "i8" => tensor_of::<i64>(array),
            "u1" => tensor_of::<u8>(array),
            _ => return Err(Error::input(path, format!("array {name}"), descr, "f4, f8, i8 or u1")),
        };
        arrays.insert(name, tensor.map_err(Error::read(path))?);
    }
    Ok(arrays)
}

fn tensor_of<T: Deserialize + Element>(array: NpyFile<impl Read>) -> std::io::Result<Tensor> {
    let shape: Vec<i64> = array.shape().iter().map(|&size| size as i64).collect();
    Ok(Tensor::from_slice(&array.into_vec::<T>()?).view(shape.as_slice()))
}

/// Writes arrays that [`read_npz`] can read.
pub fn write_npz(path: &Path, arrays: &Arrays) -> Result<()> {
    let mut writer = NpzWriter::create(path).map_err(Error::write(path))?;
    for (name, tensor) in arrays {
        match tensor.kind() {
            Kind::Float => write_array::<f32>(&mut writer, name, tensor, path)?,
            Kind::Double => write_array::<f64>(&mut writer, name, tensor, path)?,
            Kind::Int64 => write_array::<i64>(&mut writer, name, tensor, path)?,
            Kind::Uint8 => write_array::<u8>(&mut writer, name, tensor, path)?,
            other => return Err(Error::failed(format!("{name} has kind {other:?}, which isn't exchanged"))),
        }
    }
    Ok(())
}

fn write_array<T: Element + Copy + npyz::AutoSerialize>(
    writer: &mut NpzWriter<impl std::io::Write + std::io::Seek>,
    name: &str,
    tensor: &Tensor,
    path: &Path,
) -> Result<()> {
    let array: ArrayD<T> = (&tensor.contiguous()).try_into()?;
    let shape: Vec<u64> = array.shape().iter().map(|&size| size as u64).collect();
    let mut write = || -> std::io::Result<()> {
        let mut npy =
            writer.array::<T>(name, Default::default())?.default_dtype().shape(&shape).begin_nd()?;
        npy.extend(array.iter().copied())?;
        npy.finish()
    };
    write().map_err(Error::write(path))
}
