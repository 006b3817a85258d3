//! Plücker rays (spec 3.2).

use tch::{Kind, Tensor};

/// Returns one ray per pixel as [o × d ; d], moment first, where d is the unit direction in the world and o the camera centre.
///
/// The inputs are `c2w` [B, V, 4, 4] and `intrinsics` [B, V, 3, 3] in pixels; the result is [B, V, H, W, 6], float32.
pub fn plucker_rays(c2w: &Tensor, intrinsics: &Tensor, height: i64, width: i64) -> Tensor {
    let directions = pixel_directions(c2w, intrinsics, height, width);
    let origins = c2w.to_kind(Kind::Float).narrow(-2, 0, 3).select(-1, 3).unsqueeze(2).unsqueeze(2);
    plucker(&origins.expand_as(&directions), &directions)
}

/// Returns the rays [o × d ; d], [.., 6], from `origins` [.., 3] along `directions` [.., 3] of any length.
pub(super) fn plucker(origins: &Tensor, directions: &Tensor) -> Tensor {
    let directions = directions / directions.norm_scalaropt_dim(2, [-1i64], true);
    Tensor::cat(&[origins.linalg_cross(&directions, -1), directions], -1)
}

/// Returns the world direction of each pixel, [B, V, H, W, 3], float32, with length 1 along the camera's axis.
pub(super) fn pixel_directions(c2w: &Tensor, intrinsics: &Tensor, height: i64, width: i64) -> Tensor {
    let (c2w, intrinsics) = (c2w.to_kind(Kind::Float), intrinsics.to_kind(Kind::Float));
    let options = (Kind::Float, c2w.device());
    let entry =
        |row: i64, column: i64| intrinsics.select(-2, row).select(-1, column).unsqueeze(-1).unsqueeze(-1);
    // x = (j + ½ − cx) / fx along a row, y = (i + ½ − cy) / fy down a column, each [B, V, H, W].
    let j = (Tensor::arange(width, options) + 0.5).view([1, 1, 1, width]);
    let i = (Tensor::arange(height, options) + 0.5).view([1, 1, height, 1]);
    let x = ((j - entry(0, 2)) / entry(0, 0)).expand([-1, -1, height, -1], false);
    let y = ((i - entry(1, 2)) / entry(1, 1)).expand([-1, -1, -1, width], false);
    let camera = Tensor::stack(&[&x, &y, &x.ones_like()], -1);
    let rotation = c2w.narrow(-2, 0, 3).narrow(-1, 0, 3);
    let flat = camera.flatten(2, 3).matmul(&rotation.transpose(-1, -2));
    let (b, v) = (flat.size()[0], flat.size()[1]);
    flat.view([b, v, height, width, 3])
}
