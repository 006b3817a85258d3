//! Models: their weights, and reconstruction with them.

use crate::capture::Capture;
use crate::splat::{in_world, to_dict};
use crate::work::run;
use globalsplat::Result;
use globalsplat::data::Holdout;
use globalsplat::model::{Precision, Stage};
use globalsplat::reconstruct::{LoadedModel, ModelFile, load_context, model_weights};
use numpy::{PyArray, PyArrayMethods};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::{Path, PathBuf};
use tch::Device;

/// Reconstructs a splat. Returns its parameters and the warnings.
#[pyfunction]
pub fn reconstruct<'py>(
    py: Python<'py>,
    capture: &Capture,
    weights: Option<PathBuf>,
    views: Option<usize>,
    cuda: Option<usize>,
) -> PyResult<(Bound<'py, PyDict>, Vec<String>)> {
    let (mut splat, assumed) = run(py, || {
        let model = load(weights.as_deref(), device(cuda), None)?;
        let data = &model.config.data;
        let count = views.unwrap_or(data.context_views);
        let photos = load_context(&capture.0, Holdout::None, Some(count), data.image_size)?;
        let reconstruction = globalsplat::reconstruct::reconstruct(&model, &photos, &[])?;
        Ok((in_world(reconstruction.to_splat()?), model.assumed))
    })?;
    let warnings: Vec<String> = splat
        .warnings
        .drain(..)
        .chain(assumed.map(|model| format!("the weights are taken for {model}")))
        .collect();
    Ok((to_dict(py, splat)?, warnings))
}

/// Opens the weights in a file, or the bundled ones, for inference.
pub fn load(weights: Option<&Path>, device: Device, precision: Option<Precision>) -> Result<LoadedModel> {
    let file = ModelFile::open_or_bundled(weights)?;
    let precision = precision.unwrap_or_else(|| Precision::best_on(device, file.config.model.width));
    file.load(device, precision)
}

/// Weights, configuration, curriculum stage and transition of a model.
type ModelParts<'py> = (Bound<'py, PyDict>, String, u32, f64);

/// Reads a model for the reference implementation in PyTorch: arrays in float32 by name, the program's configuration as JSON, and the
/// stage that the weights were trained to.
#[pyfunction]
pub fn read_model(py: Python<'_>, weights: Option<PathBuf>) -> PyResult<ModelParts<'_>> {
    let model = run(py, || load(weights.as_deref(), Device::Cpu, Some(Precision::F32)))?;
    let dict = PyDict::new(py);
    for (name, tensor) in model_weights(&model.vs, &model.config, model.stage, Precision::F32).tensors {
        let shape: Vec<usize> = tensor.size().iter().map(|&size| size as usize).collect();
        let values = Vec::<f32>::try_from(tensor.flatten(0, -1));
        let values = values.map_err(|why| PyRuntimeError::new_err(why.to_string()))?;
        dict.set_item(name, PyArray::from_vec(py, values).reshape(shape)?)?;
    }
    let config =
        serde_json::to_string(&model.config.model).map_err(|why| PyRuntimeError::new_err(why.to_string()))?;
    let Stage { index, mix } = model.stage;
    Ok((dict, config, index, mix))
}

/// Returns the CUDA device of this index, or the CPU.
pub fn device(cuda: Option<usize>) -> Device {
    cuda.map_or(Device::Cpu, Device::Cuda)
}
