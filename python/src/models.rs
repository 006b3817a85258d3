//! Models: their weights, and reconstruction with them.

use crate::capture::Capture;
use crate::splat::to_dict;
use crate::work::run;
use globalsplat::data::Holdout;
use globalsplat::model::Precision;
use globalsplat::reconstruct::{ModelFile, load_context};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;
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
        let (file, device) = (ModelFile::open_or_bundled(weights.as_deref())?, device(cuda));
        let precision = Precision::best_on(device, file.config.model.width);
        let model = file.load(device, precision)?;
        let data = &model.config.data;
        let count = views.unwrap_or(data.context_views);
        let photos = load_context(&capture.0, Holdout::None, Some(count), data.image_size)?;
        let reconstruction = globalsplat::reconstruct::reconstruct(&model, &photos, &[])?;
        Ok((reconstruction.to_splat()?, model.assumed))
    })?;
    let warnings: Vec<String> = splat
        .warnings
        .drain(..)
        .chain(assumed.map(|model| format!("the weights are taken for {model}")))
        .collect();
    Ok((to_dict(py, splat)?, warnings))
}

/// Returns the CUDA device of this index, or the CPU.
pub fn device(cuda: Option<usize>) -> Device {
    cuda.map_or(Device::Cpu, Device::Cuda)
}
