//! Plücker rays (spec 3.2).

use tch::{Kind, Tensor};

/// Returns one ray per pixel as [o × d ; d], moment first, where d is the unit direction in the world and o the camera centre.
///
/// The inputs are `c2w` [B, V, 4, 4] and `intrinsics` [B, V, 3, 3] in pixels; the result is [B, V, H, W, 6], float32.
pub fn plucker_rays(c2w: &Tensor, intrinsics: &Tensor, height: i64, width: i64) -> Tensor {
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
    let direction = &flat / flat.norm_scalaropt_dim(2, [-1i64], true);
    let origin = c2w.narrow(-2, 0, 3).select(-1, 3).unsqueeze(2).expand_as(&direction);
    let rays = Tensor::cat(&[origin.linalg_cross(&direction, -1), direction], -1);
    let (b, v) = (rays.size()[0], rays.size()[1]);
    rays.view([b, v, height, width, 6])
}
