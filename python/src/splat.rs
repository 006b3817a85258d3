//! Splat files as dictionaries of arrays.

use crate::capture::Capture;
use crate::error::to_python;
use crate::work::run;
use glam::DVec3;
use globalsplat::io::{
    ShLimits, Splat, WriteOptions, check_writable_splat, fit_splat, rounding_warning, write_local_splat,
};
use globalsplat::render::{ANTIALIASED_EPS2D, DEFAULT_EPS2D};
use numpy::ndarray::Dimension;
use numpy::{PyArray, PyArrayMethods, PyReadonlyArray, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;

/// Reads a splat file of any format. Returns the parameters that 3DGS optimizes, and the warnings of the reader.
#[pyfunction]
pub fn read_splat(py: Python<'_>, path: PathBuf) -> PyResult<(Bound<'_, PyDict>, Vec<String>)> {
    let splat = run(py, || globalsplat::io::read_splat(&path))?;
    let warnings = splat.warnings.clone();
    Ok((to_dict(py, splat)?, warnings))
}

/// Writes a splat file in the format that the file's extension names. If the format has fewer spherical harmonics, colors are fitted to
/// what the cameras of `capture` see.
#[pyfunction]
pub fn write_splat(
    py: Python<'_>,
    path: PathBuf,
    splat: Parameters,
    capture: Option<&Capture>,
) -> PyResult<()> {
    let splat = splat.into_splat()?;
    let cameras = capture.map_or(vec![], |capture| capture.0.cameras());
    run(py, || {
        check_writable_splat(&path)?;
        let fitted = fit_splat(&path, &splat, &ShLimits::up_to(splat.sh_degree), &cameras)?;
        write_local_splat(&path, &fitted, &WriteOptions::default())
    })
}

/// Returns `splat` in world coordinates, unless float32 would visibly round them.
pub fn in_world(splat: Splat) -> Splat {
    if rounding_warning(&splat).is_some() {
        return splat;
    }
    Splat { warnings: splat.warnings.clone(), ..splat.with_origin(DVec3::ZERO) }
}

/// Returns the parameters of `splat`, and the origin of its means in the world.
pub fn to_dict(py: Python<'_>, splat: Splat) -> PyResult<Bound<'_, PyDict>> {
    let (count, bases) = (splat.len(), splat.bases());
    let array = |values: Vec<f32>, shape: &[usize]| PyArray::from_vec(py, values).reshape(shape.to_vec());
    let dict = PyDict::new(py);
    dict.set_item("means", array(splat.means.into_flattened(), &[count, 3])?)?;
    dict.set_item("quats", array(splat.quaternions.into_flattened(), &[count, 4])?)?;
    dict.set_item("log_scales", array(splat.log_scales.into_flattened(), &[count, 3])?)?;
    dict.set_item("opacity_logits", array(splat.opacity_logits, &[count])?)?;
    dict.set_item("sh", array(splat.sh.into_flattened(), &[count, bases, 3])?)?;
    dict.set_item("antialiased", splat.antialiased)?;
    dict.set_item("origin", PyArray::from_slice(py, &splat.origin.to_array()))?;
    dict.set_item("eps2d", if splat.antialiased { ANTIALIASED_EPS2D } else { DEFAULT_EPS2D })?;
    Ok(dict)
}

/// Parameters of Gaussians, as [`to_dict`] returns them.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Parameters<'py> {
    means: PyReadonlyArray2<'py, f32>,
    quats: PyReadonlyArray2<'py, f32>,
    log_scales: PyReadonlyArray2<'py, f32>,
    opacity_logits: PyReadonlyArray1<'py, f32>,
    sh: PyReadonlyArray3<'py, f32>,
    antialiased: bool,
    origin: [f64; 3],
}

impl Parameters<'_> {
    /// Returns the splat.
    pub fn into_splat(self) -> PyResult<Splat> {
        let bases = self.sh.as_array().shape()[1];
        let degree = bases.isqrt().wrapping_sub(1);
        if degree > 3 || (degree + 1).pow(2) != bases {
            return Err(PyValueError::new_err(format!(
                "colors has {bases} spherical harmonics per Gaussian, expected 1, 4, 9 or 16"
            )));
        }
        let splat = Splat::new(
            degree,
            rows(&self.means),
            rows(&self.log_scales),
            rows(&self.quats),
            rows::<1>(&self.opacity_logits).into_flattened(),
            rows(&self.sh),
        )
        .map_err(to_python)?;
        Ok(Splat { antialiased: self.antialiased, origin: self.origin.into(), ..splat })
    }
}

/// Returns the numbers of an array in rows of N. The Python side has checked its shape and made it contiguous.
fn rows<const N: usize>(array: &PyReadonlyArray<'_, f32, impl Dimension>) -> Vec<[f32; N]> {
    array.as_slice().expect("a contiguous array").as_chunks().0.to_vec()
}
