//! Captures: photos and their cameras.

use crate::error::to_python;
use crate::work::run;
use glam::{DMat4, DVec4};
use globalsplat::data::{ImageSource, open_capture as open, read_points};
use globalsplat::scene::{Camera, Intrinsics};
use image::RgbImage;
use numpy::{
    PyArray, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray3, PyReadonlyArray4, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use std::path::PathBuf;
use std::sync::Arc;

/// Positions and colors of points.
type Points<'py> = (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<f32>>);

/// Photos with known cameras. Photos are read when they are needed.
#[pyclass(frozen, module = "globalsplat")]
pub struct Capture(pub globalsplat::data::Capture);

/// Opens a capture of any format that the program reads.
#[pyfunction]
#[pyo3(signature = (path, masks=None))]
pub fn open_capture(py: Python<'_>, path: PathBuf, masks: Option<PathBuf>) -> PyResult<Capture> {
    let opened = run(py, || {
        let capture = open(&path)?;
        match &masks {
            Some(folder) => Ok(capture.with_masks(folder)?),
            None => Ok(capture),
        }
    });
    Ok(Capture(opened?))
}

/// Creates a capture from images in memory: `images` [V, H, W, 3], `viewmats` [V, 4, 4] and `intrinsics` [V, 3, 3] in pixels, without skew.
/// The caller has checked their shapes.
#[pyfunction]
pub fn capture_from_images(
    images: PyReadonlyArray4<'_, u8>,
    viewmats: PyReadonlyArray3<'_, f64>,
    intrinsics: PyReadonlyArray3<'_, f64>,
) -> PyResult<Capture> {
    let &[count, height, width, _] = images.shape() else { unreachable!("the array has four dimensions") };
    let images = images.as_array();
    let image = |index: usize| {
        let pixels = images.index_axis(numpy::ndarray::Axis(0), index).iter().copied().collect();
        RgbImage::from_raw(width as u32, height as u32, pixels).expect("as many pixels as its size says")
    };
    let (w2c, k) = (viewmats.as_array(), intrinsics.as_array());
    let camera = |view: usize| {
        let column = |column: usize| DVec4::from_array(std::array::from_fn(|row| w2c[[view, row, column]]));
        let w2c = DMat4::from_cols(column(0), column(1), column(2), column(3));
        let intrinsics =
            Intrinsics { fx: k[[view, 0, 0]], fy: k[[view, 1, 1]], cx: k[[view, 0, 2]], cy: k[[view, 1, 2]] };
        Camera { intrinsics, c2w: w2c.inverse(), width: width as u32, height: height as u32 }
    };
    let cameras: Vec<Camera> = (0..count).map(camera).collect();
    let source = Arc::new(Images((0..count).map(image).collect()));
    let capture = globalsplat::data::Capture::from_source("images".into(), "images".into(), &cameras, source);
    Ok(Capture(capture.map_err(to_python)?))
}

#[pymethods]
impl Capture {
    /// Name of the capture.
    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }

    /// Names of the photos.
    #[getter]
    fn names(&self) -> Vec<String> {
        self.0.names().map(String::from).collect()
    }

    /// Messages about what was left out or changed when the capture was opened, a sentence each.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.0.warnings().to_vec()
    }

    /// Width and height of every photo.
    #[getter]
    fn sizes(&self) -> Vec<(u32, u32)> {
        self.0.cameras().iter().map(|camera| (camera.width, camera.height)).collect()
    }

    /// World-to-camera matrices with OpenCV axes, [V, 4, 4].
    #[getter]
    fn viewmats<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let rows = |camera: &Camera| camera.c2w.inverse().transpose().to_cols_array();
        let numbers: Vec<f64> = self.0.cameras().iter().flat_map(rows).collect();
        PyArray::from_vec(py, numbers).reshape([self.0.len(), 4, 4])
    }

    /// Intrinsic matrices in pixels, [V, 3, 3].
    #[getter(Ks)]
    fn intrinsics<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let numbers: Vec<f64> =
            self.0.cameras().iter().flat_map(|camera| camera.intrinsics.to_rows()).collect();
        PyArray::from_vec(py, numbers).reshape([self.0.len(), 3, 3])
    }

    /// Points of a COLMAP reconstruction and their colors in [0, 1], two arrays [P, 3]; empty if the capture has none.
    fn points<'py>(&self, py: Python<'py>) -> PyResult<Points<'py>> {
        let points = run(py, || read_points(&self.0))?;
        let positions: Vec<f64> = points.iter().flat_map(|point| point.position.to_array()).collect();
        let colors: Vec<f32> = points.iter().flat_map(|point| point.color).collect();
        let shape = [points.len(), 3];
        Ok((PyArray::from_vec(py, positions).reshape(shape)?, PyArray::from_vec(py, colors).reshape(shape)?))
    }

    /// Reads a photo, without its lens distortion, at the size of its camera: [H, W, 3].
    fn image<'py>(&self, py: Python<'py>, index: isize) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let count = self.0.len() as isize;
        if !(-count..count).contains(&index) {
            return Err(PyIndexError::new_err(format!("photo {index} of {count}")));
        }
        let index = index.rem_euclid(count) as usize;
        let photo = run(py, || Ok(self.0.photo_with_mask(index)?.0))?;
        let (width, height) = photo.dimensions();
        PyArray::from_vec(py, photo.into_raw()).reshape([height as usize, width as usize, 3])
    }

    fn __len__(&self) -> usize {
        self.0.len()
    }

    fn __repr__(&self) -> String {
        format!("Capture({:?}, {} photos)", self.0.name, self.0.len())
    }
}

/// Images in memory.
#[derive(Debug)]
struct Images(Vec<RgbImage>);

impl ImageSource for Images {
    fn name(&self) -> &str {
        "the images"
    }

    fn image(&self, index: usize) -> RgbImage {
        self.0[index].clone()
    }

    fn depth(&self, _: usize) -> Option<Vec<f32>> {
        None
    }
}
