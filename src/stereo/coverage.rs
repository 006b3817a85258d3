//! Which pixels of a view show surfaces that several photos show, too.

use super::{DepthMap, pixel_and_depth};
use crate::scene::Camera;
use glam::DVec3;
use tch::Tensor;

/// Longer side of the cells that are covered or not, in cells.
const CELLS: f64 = 64.;
/// Maximum ratio of two photos' depths of a cell that are the same surface's.
const SAME_SURFACE: f64 = 1.1;

/// Returns a mask [1, H, W] of the pixels of `camera` that at least two of `depth_maps` cover: the nearest surface there of which one photo
/// is sure is within 10 % of the depth of another photo's.
pub(crate) fn covered(depth_maps: &[DepthMap], camera: &Camera) -> Tensor {
    let factor = (CELLS / f64::from(camera.width.max(camera.height))).min(1.);
    let [width, height] = [camera.width, camera.height].map(|side| (f64::from(side) * factor).ceil());
    let scale = [width / f64::from(camera.width), height / f64::from(camera.height)];
    let intrinsics = camera.intrinsics.resized(scale[0], scale[1]);
    let cells = Camera { intrinsics, width: width as u32, height: height as u32, ..*camera };
    let project = pixel_and_depth(&cells);
    // Of each cell the depths of the two nearest photos.
    let mut nearest = vec![[f64::INFINITY; 2]; (width * height) as usize];
    for map in depth_maps {
        let mut of_map = vec![f64::INFINITY; nearest.len()];
        for (cell, z) in map.sure_points().filter_map(&project) {
            of_map[cell] = z.min(of_map[cell]);
        }
        for (nearest, z) in nearest.iter_mut().zip(of_map) {
            let [first, second] = *nearest;
            *nearest = [first.min(z), second.min(first.max(z))];
        }
    }
    let is_covered: Vec<f32> =
        nearest.iter().map(|[a, b]| f32::from(b.is_finite() && *b <= SAME_SURFACE * a)).collect();
    let mask = Tensor::from_slice(&is_covered).view([1, 1, height as i64, width as i64]);
    mask.upsample_nearest2d([i64::from(camera.height), i64::from(camera.width)], None, None).squeeze_dim(0)
}

impl DepthMap {
    /// Returns the points of the pixels that count and on whose depth the photos agree.
    fn sure_points(&self) -> impl Iterator<Item = DVec3> {
        let (camera, width) = (self.camera, self.camera.width as usize);
        let (sure, counted) = (self.sure_pixels(), self.counted_pixels());
        self.depths().into_iter().enumerate().filter_map(move |(pixel, z)| {
            let is_known = sure[pixel] && counted.as_ref().is_none_or(|counted| counted[pixel]);
            let [u, v] = [pixel % width, pixel / width].map(|side| side as f64 + 0.5);
            is_known.then(|| camera.unproject(u, v, z.into()))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat4;
    use tch::Kind;

    /// Photos show a wall at depth 4, one of them with a wrong depth in front of it.
    #[test]
    fn pixels_are_covered_where_the_nearest_surface_is_that_of_two_photos() {
        let wall = |x: f64, depth: f64| {
            let map = DepthMap::flat(16, 16, depth);
            DepthMap { camera: Camera { c2w: DMat4::from_translation(DVec3::X * x), ..map.camera }, ..map }
        };
        let camera = Camera { width: 8, height: 8, ..wall(0., 4.).camera };
        let camera = Camera { intrinsics: camera.intrinsics.resized(0.5, 0.5), ..camera };
        let of =
            |maps: &[DepthMap]| covered(maps, &camera).sum_dim_intlist([1i64].as_slice(), false, Kind::Int64);
        let columns = |maps: &[DepthMap]| Vec::<i64>::try_from(of(maps).view([-1])).unwrap();
        assert_eq!(columns(&[wall(0., 4.)]), [0; 8]);
        // Half of the second photo is outside the view.
        let width = 16. * 4. / wall(0., 4.).camera.intrinsics.fx;
        assert_eq!(columns(&[wall(0., 4.), wall(width / 2., 4.2)]), [0, 0, 0, 0, 8, 8, 8, 8]);
        assert_eq!(columns(&[wall(0., 4.), wall(0., 4.), wall(0., 2.)])[3], 0);
    }
}
