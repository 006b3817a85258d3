"""gsplat's rasterization in plain PyTorch: its own projection, spherical harmonics and blending, from its PyPI wheel.

Two of the steps that gsplat implements only in CUDA are replaced: the search for the pairs of pixels and Gaussians, and nerfacc's
transmittances along rays. Everything is differentiated by autograd.
"""

import sys
import types

import torch
from torch import Tensor

MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE = 1 / 255, 0.999, 1e-4


def transmittances(alphas: Tensor, rays: Tensor) -> Tensor:
    """Returns the product of 1 - alpha over the earlier samples of the same ray. Samples of a ray are consecutive."""
    logs = torch.log1p(-alphas)
    before = torch.cumsum(logs, 0) - logs
    is_first = torch.cat([torch.ones_like(rays[:1], dtype=torch.bool), rays[1:] != rays[:-1]])
    first = torch.where(is_first, torch.arange(len(rays)), 0).cummax(0).values
    return torch.exp(before - before[first])


def accumulate_along_rays(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
    terms = weights[:, None] if values is None else weights[:, None] * values
    return terms.new_zeros(n_rays, terms.shape[1]).index_add(0, ray_indices, terms)


def render_weight_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    before = transmittances(alphas, ray_indices)
    return alphas * before, before


nerfacc = types.ModuleType("nerfacc")
nerfacc.accumulate_along_rays = accumulate_along_rays
nerfacc.render_weight_from_alpha = render_weight_from_alpha
sys.modules["nerfacc"] = nerfacc

from gsplat.cuda._torch_impl import (  # noqa: E402 (needs the replacement of nerfacc)
    _fully_fused_projection,
    _quat_scale_to_covar_preci,
    _spherical_harmonics,
    accumulate,
)


def rasterization(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    near_plane=0.01,
    far_plane=1e10,
    eps2d=0.3,
    sh_degree=None,
    backgrounds=None,
    render_mode="RGB",
    rasterize_mode="classic",
    threshold_factor=1.0,
):
    """Returns what gsplat's `rasterization` returns, for inputs without batch dimensions and with colours [N, D] or [N, K, 3].

    `threshold_factor` scales the two thresholds that decide whether a Gaussian counts at a pixel.
    """
    covars, _ = _quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, means2d, depths, conics, compensations = _fully_fused_projection(
        means, covars, viewmats, Ks, width, height, eps2d, near_plane, far_plane, rasterize_mode == "antialiased"
    )
    cameras, count = depths.shape
    opacities = opacities.expand(cameras, count)
    if compensations is not None:
        opacities = opacities * compensations
    if sh_degree is None:
        colors = colors.expand(cameras, count, -1)
    else:
        directions = means - torch.inverse(viewmats)[:, None, :3, 3]
        bases = (sh_degree + 1) ** 2
        colors = torch.clamp_min(
            _spherical_harmonics(sh_degree, directions, colors[:, :bases].expand(cameras, -1, -1, -1)) + 0.5, 0.0
        )
    if render_mode in ("D", "ED"):
        colors, backgrounds = depths[..., None], None
    elif render_mode != "RGB":
        colors = torch.cat([colors, depths[..., None]], -1)
        if backgrounds is not None:
            backgrounds = torch.nn.functional.pad(backgrounds, (0, 1))

    image_ids, pixel_ids, gaussian_ids = visible_pairs(
        means2d, conics, opacities, depths, (radii > 0).all(-1), width, height, threshold_factor
    )
    renders, alphas = accumulate(means2d, conics, opacities, colors, gaussian_ids, pixel_ids, image_ids, width, height)
    if backgrounds is not None:
        renders = renders + (1.0 - alphas) * backgrounds[:, None, None]
    if render_mode.endswith("ED"):
        renders = torch.cat([renders[..., :-1], renders[..., -1:] / alphas.clamp(min=1e-10)], -1)
    # The CUDA kernel also gets the opacities, and draws narrower boxes with them.
    extents = (2.0 * torch.log(255.0 * opacities)).clamp(min=0.0).sqrt().clamp(max=3.33)
    variances = conics[..., [2, 0]] / (conics[..., 0] * conics[..., 2] - conics[..., 1] ** 2)[..., None]
    narrow = torch.ceil(extents[..., None] * variances.sqrt())
    size = torch.tensor([width, height])
    is_inside = ((means2d + narrow > 0) & (means2d - narrow < size)).all(-1)
    is_visible = is_inside & (radii > 0).all(-1) & (opacities >= MIN_ALPHA)
    radii = torch.where(is_visible[..., None], narrow, 0.0).int()
    return (
        renders,
        alphas,
        {"radii": radii, "means2d": means2d, "depths": depths, "conics": conics, "opacities": opacities},
    )


@torch.no_grad()
def visible_pairs(means2d, conics, opacities, depths, is_visible, width, height, threshold_factor):
    """Returns the image, the pixel and the Gaussian of each pair that is blended, front to back for each pixel."""
    ys, xs = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([xs.flatten(), ys.flatten()], -1).to(means2d.dtype)
    pairs = []
    for image in range(len(means2d)):
        order = depths[image].argsort(stable=True)
        order = order[is_visible[image, order]]
        dx, dy = (pixels[:, None] - means2d[image, order]).unbind(-1)
        xx, xy, yy = conics[image, order].unbind(-1)
        sigmas = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
        alphas = (opacities[image, order] * torch.exp(-sigmas)).clamp_max(MAX_ALPHA)
        is_blended = alphas >= MIN_ALPHA * threshold_factor
        after = torch.cumprod(torch.where(is_blended, 1.0 - alphas, 1.0), 1)
        is_blended &= after > MIN_TRANSMITTANCE * threshold_factor
        pixel_ids, positions = is_blended.nonzero(as_tuple=True)
        pairs.append((torch.full_like(pixel_ids, image), pixel_ids, order[positions]))
    return tuple(torch.cat(column) for column in zip(*pairs, strict=True))
