//! Search for the depths of a photo by comparison with others. Tensors are passed as addresses of `at::Tensor`, which is tch's `C_tensor`.

pub use ffi::*;

// Clippy doesn't see the safety sections inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// Photo that is compared with the one whose depths are searched.
    struct PhotoToCompare {
        /// Address of the grey values, [h, w].
        grey: usize,
        /// Address of the weights of the pixels, [h, w]; 0 if every pixel counts.
        weight: usize,
        /// Matrix of three rows that maps (column, row, 1, inverse depth) of the photo whose depths are searched to (column · z, row · z, z)
        /// of this one, row by row.
        to_pixels: [f32; 12],
    }

    unsafe extern "C++" {
        include!("depth_search.h");

        /// Searches for the depths of a photo; see `csrc/depth_search.h`.
        ///
        /// # Safety
        /// All addresses must be those of live tensors, or 0 for weights.
        unsafe fn search_depths(
            grey: usize,
            weight: usize,
            others: &[PhotoToCompare],
            step: f32,
            planes: i32,
            out: &mut [usize],
        ) -> Result<()>;

        /// Searches for the depths of a photo by semi-global matching; see `csrc/depth_search.h`.
        ///
        /// # Safety
        /// All addresses must be those of live tensors, or 0 for weights.
        unsafe fn match_semi_globally(
            grey: usize,
            weight: usize,
            others: &[PhotoToCompare],
            step: f32,
            planes: i32,
            out: &mut [usize],
        ) -> Result<()>;
    }
}
