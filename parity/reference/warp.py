"""Radial warp of a scene: distances from the mean camera are made about equal in all directions."""

import math

import torch
import torch.nn.functional as F

from .tokens import pixel_directions

DISTANCE = 1.8  # to which the warp moves what the photos show
FARTHEST = 40.0  # depth of pixels whose inverse depth is smaller
NEAREST = 0.5  # distance of what is closer
CELLS = 128  # along each side of the map of directions
# The finest blur in cells, their number, and the weight of each relative to the next finer one.
BLUR, BLURS, COARSER = 1.0, 4, 0.02
PRIOR = 1e-6  # weight of DISTANCE


def points(c2w, intrinsics, inverse_depths):
    """Returns the points [B, V, H, W, 3] that the pixels show at inverse depths [B, V, H, W]."""
    directions = pixel_directions(c2w, intrinsics, *inverse_depths.shape[-2:])
    return c2w[:, :, None, None, :3, 3] + directions / inverse_depths[..., None]


def map_position(xs):
    """Returns the azimuthal equidistant projection about the z axis of directions [..., 3]: [..., 2], from -1 to 1."""
    across = xs[..., :2]
    radius = ((across * across).sum(-1, keepdim=True) + 1e-12).sqrt()
    return across / radius * torch.atan2(radius, xs[..., 2:]) / math.pi


def histogram(places, values):
    """Adds up values [N] at places [N, 2], each shared linearly among the four cells around it: [cells, cells]."""
    at = ((places + 1.0) * (CELLS / 2) - 0.5).clamp(0.0, CELLS - 1.0)
    cells = torch.arange(CELLS, dtype=at.dtype)
    columns, rows = ((1.0 - (at[:, i, None] - cells).abs()).clamp(min=0.0) for i in (0, 1))  # [N, cells] each
    return torch.einsum("n,ny,nx->yx", values, rows, columns)


def blurred(image, sigma):
    """Convolves image [cells, cells] with a Gaussian, cut off at three standard deviations, zero outside."""
    reach = math.ceil(3.0 * sigma)
    offsets = torch.arange(-reach, reach + 1, dtype=image.dtype)
    kernel = torch.exp(-0.5 * (offsets / sigma) ** 2)
    kernel = kernel / kernel.sum()
    distance = torch.arange(CELLS)[:, None] - torch.arange(CELLS) + reach
    inside = (distance >= 0) & (distance <= 2 * reach)
    matrix = torch.where(inside, kernel[distance.clamp(0, 2 * reach)], 0.0)
    return matrix @ image @ matrix.T


class RadialWarp:
    """The warp of views with c2w [B, V, 4, 4], intrinsics [B, V, 3, 3] and depths [B, V, 2, H, W]: inverse depth, confidence.

    A point X of the normalized world becomes exp(-l) X, where l is the map of directions at X: the mean of
    log(|X| / DISTANCE) over the pixels around, weighted by how sure their depths are.
    """

    def __init__(self, c2w, intrinsics, depths):
        self.inverse_depths = depths[:, :, 0].clamp(min=1.0 / FARTHEST)
        xs = points(c2w, intrinsics, self.inverse_depths).flatten(1, 3)
        weights = depths[:, :, 1].flatten(1)
        logs = torch.log(xs.norm(dim=-1).clamp(min=NEAREST) / DISTANCE) * weights
        maps = []
        for x, log, weight in zip(xs, logs, weights, strict=True):
            places = map_position(x)
            sums = [histogram(places, values) for values in (log, weight)]
            log_sum, weight_sum = (
                sum(COARSER**level * blurred(total, BLUR * 2**level) for level in range(BLURS)) for total in sums
            )
            maps.append(log_sum / (weight_sum + PRIOR))
        self.map = torch.stack(maps)[:, None]
        self.camera_factors = torch.exp(-0.5 * logs.sum(1) / (weights.sum(1) + PRIOR))

    def log_factors_at(self, xs):
        """Returns l in the directions of xs [B, N, 3]: [B, N]."""
        places = map_position(xs)[:, :, None]
        return F.grid_sample(self.map, places, padding_mode="border", align_corners=False)[:, 0, :, 0]

    def cameras(self, c2w):
        """Returns c2w with centers closer to the origin where the scene is far away."""
        moved = c2w.clone()
        moved[..., :3, 3] = c2w[..., :3, 3] * self.camera_factors[:, None, None]
        return moved

    def rays(self, c2w, intrinsics):
        """Returns the Plücker rays [B, V, H, W, 6] from the moved cameras through the warped points."""
        xs = points(c2w, intrinsics, self.inverse_depths)
        warped = xs * torch.exp(-self.log_factors_at(xs.flatten(1, 3))).view(*xs.shape[:-1], 1)
        origins = self.cameras(c2w)[:, :, None, None, :3, 3].expand_as(warped)
        directions = warped - origins
        directions = directions / directions.norm(dim=-1, keepdim=True)
        return torch.cat([torch.linalg.cross(origins, directions), directions], dim=-1)

    def restore(self, means, scales):
        """Moves Gaussians of the warped world back."""
        factors = torch.exp(self.log_factors_at(means))[..., None]
        return means * factors, scales * factors
