//! Search for the depths of a photo's pixels: on planes at several depths, patches are compared with those of other photos. The kernel is
//! `csrc/kernels/plane_sweep.h`. Photos are downscaled first.

use crate::ffi::take_tensors;
use crate::scene::{Camera, Intrinsics};
use glam::{DMat3, DVec3};
use globalsplat_csrc::tensor_ops::{PhotoToCompare, search_depths};
use tch::{Kind, Tensor};

/// Side in pixels of the patches that are compared, the minimum of a photo's sides.
pub const PATCH: i64 = 9;

/// Photo that is compared with the one whose depths are searched.
#[derive(Debug)]
pub struct ComparedPhoto<'a> {
    /// Gray values, [h, w].
    pub gray: &'a Tensor,
    /// Weight of each pixel, [h, w]; `None` if every pixel counts.
    pub weight: Option<&'a Tensor>,
    /// Columns of the matrix that maps (column, row, 1, inverse depth) of the photo whose depths are searched to
    /// (column · z, row · z, z) of this one. The center of the first pixel is at ½.
    pub to_pixels: [DVec3; 4],
}

/// Search for the depths of a photo's pixels among the multiples 0 to `planes` − 1 of an inverse depth.
#[derive(Debug, Clone, Copy)]
pub enum Search {
    /// The inverse depth at which a pixel looks most alike in the other photos, and the correlation there: that of the patches around the
    /// pixel, weighted by the product of both photos' weights, on average over the better half of the photos. It is −1 for a photo that
    /// doesn't show the pixel, or in which less than half of it, or less than a quarter of the patch, counts.
    PatchCorrelation,
    /// The inverse depth by semi-global matching, and how sure it is, in [0, 1]. The costs are those of the candidates of the other search;
    /// depths that differ little between pixels cost less (`csrc/kernels/semi_global.h`).
    SemiGlobal,
}

impl Search {
    /// Returns the inverse depth of every pixel of `gray` [h, w], among the multiples of `step`, and its correlation or how sure it is, both
    /// [h, w], float32 on the CPU.
    ///
    /// # Panics
    /// Panics if there are no other photos or no planes, or if shapes don't fit.
    pub fn run(
        self,
        gray: &Tensor,
        weight: Option<&Tensor>,
        others: &[ComparedPhoto],
        step: f64,
        planes: i64,
    ) -> (Tensor, Tensor) {
        let address = |tensor: Option<&Tensor>| tensor.map_or(0, |tensor| tensor.as_ptr() as usize);
        let others: Vec<PhotoToCompare> = others
            .iter()
            .map(|other| PhotoToCompare {
                gray: address(Some(other.gray)),
                weight: address(other.weight),
                to_pixels: std::array::from_fn(|i| other.to_pixels[i % 4][i / 4] as f32),
            })
            .collect();
        let [gray, weight] = [Some(gray), weight].map(address);
        let semi_global = matches!(self, Search::SemiGlobal);
        // SAFETY: the tensors outlive the call, which returns the addresses of new ones.
        let found = unsafe { search_depths(gray, weight, &others, step as f32, planes as i32, semi_global) };
        unsafe { take_tensors::<2>(found.unwrap_or_else(|error| panic!("{error}"))) }.into()
    }
}

/// Downscaled photo.
#[derive(Debug)]
pub(crate) struct SmallPhoto {
    pub name: String,
    pub camera: Camera,
    /// Colors, [3, h, w].
    pub image: Tensor,
    /// Mean over the color channels, [h, w].
    pub gray: Tensor,
    /// Weight of each pixel, [h, w]; `None` if every pixel counts.
    pub weight: Option<Tensor>,
}

impl SmallPhoto {
    /// Downscales a photo to at most `longest_side` pixels along its longer side. `image` [3, H, W] has values in [0, 1], and `mask`
    /// [1, H, W] is 1 where a pixel counts, both on the CPU.
    pub fn new(name: &str, image: &Tensor, mask: Option<&Tensor>, camera: Camera, longest_side: f64) -> Self {
        let side = |pixels: u32| f64::from(pixels);
        let factor = (longest_side / side(camera.width.max(camera.height))).min(1.);
        let resized = |pixels: u32| ((side(pixels) * factor).round() as i64).max(PATCH);
        let (height, width) = (resized(camera.height), resized(camera.width));
        let pool = |t: &Tensor| t.unsqueeze(0).adaptive_avg_pool2d([height, width]).squeeze_dim(0);
        let (image, weight) = pool_masked(image, mask, pool);
        let gray = image.mean_dim([0].as_slice(), false, Kind::Float);
        let scale = (width as f64 / side(camera.width), height as f64 / side(camera.height));
        let intrinsics = camera.intrinsics.resized(scale.0, scale.1);
        SmallPhoto {
            name: name.into(),
            camera: Camera { intrinsics, width: width as u32, height: height as u32, ..camera },
            image,
            gray,
            weight: weight.map(|weight| weight.squeeze_dim(0)),
        }
    }

    /// Returns the photo with at most `longest_side` pixels along its longer side.
    pub fn downscaled(&self, longest_side: f64) -> Self {
        let weight = self.weight.as_ref().map(|weight| weight.unsqueeze(0));
        SmallPhoto::new(&self.name, &self.image, weight.as_ref(), self.camera, longest_side)
    }

    /// Returns the mask of the pixels with at least half of the largest weight, [h, w]; `None` if every pixel counts.
    pub fn counted(&self) -> Option<Tensor> {
        self.weight.as_ref().map(|weight| weight.ge_tensor(&(weight.max() * 0.5)))
    }

    /// Returns this photo for a comparison with one that `camera` has taken.
    pub fn compared_with(&self, camera: &Camera) -> ComparedPhoto<'_> {
        ComparedPhoto {
            gray: &self.gray,
            weight: self.weight.as_ref(),
            to_pixels: pixels_between(camera, &self.camera),
        }
    }

    /// Returns height and width.
    pub fn size(&self) -> [i64; 2] {
        [i64::from(self.camera.height), i64::from(self.camera.width)]
    }
}

/// Returns the columns of the matrix that maps (column, row, 1, inverse depth) of a pixel of the camera `from` to (column · z, row · z, z) in
/// the camera `to`.
pub(super) fn pixels_between(from: &Camera, to: &Camera) -> [DVec3; 4] {
    // A pixel at inverse depth w is at rotation · ray + w · translation in the other camera, up to a factor.
    let transform = to.c2w.inverse() * from.c2w;
    let pixels_of = |k: &Intrinsics| DMat3::from_cols_array(&[k.fx, 0., 0., 0., k.fy, 0., k.cx, k.cy, 1.]);
    let pixels = pixels_of(&to.intrinsics);
    let of_rays = pixels * DMat3::from_mat4(transform) * pixels_of(&from.intrinsics).inverse();
    [of_rays.x_axis, of_rays.y_axis, of_rays.z_axis, pixels * transform.w_axis.truncate()]
}

/// Downscales images [.., 3, H, W] and their masks [.., 1, H, W] by `pool`. Colors are means over the pixels that count.
pub(crate) fn pool_masked(
    images: &Tensor,
    masks: Option<&Tensor>,
    pool: impl Fn(&Tensor) -> Tensor,
) -> (Tensor, Option<Tensor>) {
    const LEAST: f64 = 1e-6;
    let Some(masks) = masks else { return (pool(images), None) };
    let weights = pool(masks);
    (pool(&(images * masks)) / weights.clamp_min(LEAST), Some(weights))
}
