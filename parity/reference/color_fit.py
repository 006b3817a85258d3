"""Least-squares fit of spherical harmonics to images, for given shapes and opacities of the Gaussians."""

import math

import torch

from . import splat

UNSEEN = 1e-3  # pixels that are added to the contribution of every Gaussian


def weights(means, scales, quaternions, opacities, w2c, intrinsic, width, height):
    """Returns the weights of the Gaussians in the pixels of a camera, [H W, N]: each channel of a render is its product
    with their colors."""
    projected = splat.project(means, scales, quaternions, w2c, intrinsic, width, height)
    pixels = splat.pixel_centres(width, height, means.dtype, means.device)
    one_hot = torch.eye(len(means), dtype=means.dtype)
    return splat.composite(projected, opacities * projected["compensation"], one_hot, pixels)[0]


def fit_colors(gaussians, w2cs, intrinsics, images, masks, steps):
    """Returns the contributions [N] of Gaussians (means, scales, quaternions, opacities, sh) of one scene in pixels, and
    their SH [N, bases, 3] after some steps of accelerated gradient descent on half the sum of squared errors."""
    means, scales, quaternions, opacities, sh = gaussians
    bases = sh.shape[1]
    height, width = images.shape[-2:]
    cameras = list(zip(w2cs, intrinsics, strict=True))
    factors = [weights(means, scales, quaternions, opacities, *camera, width, height) for camera in cameras]
    contributions = sum(factor.sum(0) for factor in factors)
    degrees = torch.tensor([math.isqrt(basis) for basis in range(bases)], dtype=sh.dtype)
    bounds = bases * (2 * degrees + 1).sqrt() / (4 * math.pi)
    sizes = 1 / (contributions[:, None] * bounds + UNSEEN)

    def gradient(sh):
        total = torch.zeros_like(sh)
        for (w2c, _), factor, image, mask in zip(cameras, factors, images, masks, strict=True):
            colors = splat.sh_color(means, sh, w2c)
            error = (factor @ colors - image.flatten(1).T) * mask.flatten()[:, None]
            centre = -w2c[:3, :3].T @ w2c[:3, 3]
            direction = torch.nn.functional.normalize(means - centre, dim=-1)
            towards = (factor.T @ error) * (colors > 0)  # a color that is cut off at 0 doesn't change
            total = total + splat.sh_basis(direction, bases)[..., None] * towards[:, None]
        return total

    ahead = sh
    for step in range(1, steps + 1):
        following = ahead - gradient(ahead) * sizes[..., None]
        ahead = following + (step - 1) / (step + 2) * (following - sh)
        sh = following
    return contributions, sh
