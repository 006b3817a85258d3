//! The native module of the Python package: files, captures, reconstruction and refinement. The splat op isn't bound here: loading this
//! module registers it with PyTorch's dispatcher, as `torch.ops.globalsplat`.
//!
//! Arrays are NumPy's. The Python side documents every function, in `globalsplat/`.

mod capture;
mod error;
mod models;
mod refine;
mod splat;
mod work;

use pyo3::prelude::*;

#[pymodule]
mod _native {
    #[pymodule_export]
    use super::capture::{Capture, capture_from_images, open_capture};
    #[pymodule_export]
    use super::models::{read_model, reconstruct};
    #[pymodule_export]
    use super::refine::refine;
    #[pymodule_export]
    use super::simd_level;
    #[pymodule_export]
    use super::splat::{read_splat, write_splat};
}

/// Returns the instruction set of the rasterizer's CPU kernels: avx512, avx2, neon or portable.
#[pyfunction]
fn simd_level() -> PyResult<String> {
    globalsplat::render::cpu::simd_level().map_err(error::to_python)
}
