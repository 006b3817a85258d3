"""Tokens of the views: [ray patch + camera code ; RGB patch]."""

import torch

from .layers import linear
from .rays import camera_code, plucker_rays

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def patchify(image, patch):
    """Splits [B, V, C, H, W] into patches [B, V, P, p p C]: row-major, each flattened as (row, column, channel)."""
    b, v, c, h, w = image.shape
    cut = image.reshape(b, v, c, h // patch, patch, w // patch, patch)
    cut = cut.permute(0, 1, 3, 5, 4, 6, 2)  # B, V, patch row, patch column, row, column, channel
    return cut.reshape(b, v, (h // patch) * (w // patch), patch * patch * c)


def rgb_tokens(params, images, patch):
    """Embeds images [B, V, 3, H, W] in [0, 1]. Returns [B, V, P, RGB width]."""
    mean = torch.tensor(IMAGENET_MEAN, dtype=images.dtype, device=images.device)[:, None, None]
    std = torch.tensor(IMAGENET_STD, dtype=images.dtype, device=images.device)[:, None, None]
    return linear(params, "rgb_patch_embeds.1", patchify((images - mean) / std, patch))


def ray_tokens(params, c2w, intrinsic, height, width, patch, with_camera_code=True):
    """Embeds rays and camera codes. Returns [B, V, P, ray width]; all patches of a view have the same camera code."""
    rays = plucker_rays(c2w, intrinsic, height, width)
    tokens = linear(params, "ray_patch_embeds.1", patchify(rays, patch))
    if with_camera_code:
        tokens = tokens + camera_code(params, c2w, intrinsic, height, width)[:, :, None]
    return tokens


def view_tokens(config, params, images, c2w, intrinsic):
    """Returns tokens [B, V, P, ray width + RGB width]. config["camera_code"] false is the ablation "Plücker only"."""
    height, width = images.shape[-2:]
    patch = config["patch_size"]
    ray = ray_tokens(params, c2w, intrinsic, height, width, patch, config.get("camera_code", True))
    return torch.cat([ray, rgb_tokens(params, images, patch)], dim=-1)
