//! Search for the depths of a photo's pixels: on planes at several depths, patches are compared with those of other photos. The kernel is
//! `csrc/kernels/plane_sweep.h`.

use crate::ffi::take_outputs;
use glam::DVec3;
use globalsplat_csrc::depth_search::{self as kernel, PhotoToCompare};
use tch::Tensor;

/// Side in pixels of the patches that are compared, the minimum of a photo's sides.
pub const PATCH: i64 = 9;

/// Photo that is compared with the one whose depths are searched.
#[derive(Debug)]
pub struct ComparedPhoto<'a> {
    /// Grey values, [h, w].
    pub grey: &'a Tensor,
    /// Weight of each pixel, [h, w]; `None` if every pixel counts.
    pub weight: Option<&'a Tensor>,
    /// Columns of the matrix that maps (column, row, 1, inverse depth) of the photo whose depths are searched to
    /// (column · z, row · z, z) of this one. The centre of the first pixel is at ½.
    pub to_pixels: [DVec3; 4],
}

/// Search for the depths of a photo: [`search_depths`] or [`match_semi_globally`].
pub type Search = fn(&Tensor, Option<&Tensor>, &[ComparedPhoto], f64, i64) -> (Tensor, Tensor);

/// Returns the inverse depth at which each pixel of `grey` [h, w] looks most alike in the other photos, and the correlation there, both
/// [h, w], float32 on the CPU. The candidates are the multiples 0 to `planes` − 1 of `step`.
///
/// The correlation is that of the patches around the pixel, weighted by the product of both photos' weights, on average over the better
/// half of the photos. It is −1 for a photo that doesn't show the pixel, or in which less than half of it, or less than a quarter of the
/// patch, counts.
///
/// # Panics
/// Panics if there are no other photos or no planes, or if shapes don't fit.
pub fn search_depths(
    grey: &Tensor,
    weight: Option<&Tensor>,
    others: &[ComparedPhoto],
    step: f64,
    planes: i64,
) -> (Tensor, Tensor) {
    run(kernel::search_depths, grey, weight, others, step, planes)
}

/// Returns the inverse depths of the pixels of `grey` [h, w] by semi-global matching, and how sure each is, in [0, 1], both [h, w], float32
/// on the CPU. The costs are those of the candidates of [`search_depths`]; depths that differ little between pixels cost less
/// (`csrc/kernels/semi_global.h`).
///
/// # Panics
/// Panics if there are no other photos or no planes, or if shapes don't fit.
pub fn match_semi_globally(
    grey: &Tensor,
    weight: Option<&Tensor>,
    others: &[ComparedPhoto],
    step: f64,
    planes: i64,
) -> (Tensor, Tensor) {
    run(kernel::match_semi_globally, grey, weight, others, step, planes)
}

/// Search as this module's kernels export it: addresses of the photo and its weights, the photos to compare, the step and number of planes,
/// and where the addresses of two new tensors are stored.
type Kernel =
    unsafe fn(usize, usize, &[PhotoToCompare], f32, i32, &mut [usize]) -> Result<(), cxx::Exception>;

fn run(
    kernel: Kernel,
    grey: &Tensor,
    weight: Option<&Tensor>,
    others: &[ComparedPhoto],
    step: f64,
    planes: i64,
) -> (Tensor, Tensor) {
    let address = |tensor: Option<&Tensor>| tensor.map_or(0, |tensor| tensor.as_ptr() as usize);
    let others: Vec<PhotoToCompare> = others
        .iter()
        .map(|other| PhotoToCompare {
            grey: address(Some(other.grey)),
            weight: address(other.weight),
            to_pixels: std::array::from_fn(|i| other.to_pixels[i % 4][i / 4] as f32),
        })
        .collect();
    let [grey, weight] = [Some(grey), weight].map(address);
    // SAFETY: the tensors outlive the call, and on success the C++ side has stored two new tensors in `out`.
    let search =
        |out: &mut [usize]| unsafe { kernel(grey, weight, &others, step as f32, planes as i32, out) };
    let done = unsafe { take_outputs(search) };
    let [first, second] = done.unwrap_or_else(|error| panic!("{error}"));
    (first, second)
}
