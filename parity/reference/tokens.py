"""Tokens of the views, [ray patch + camera code ; RGB patch], from images and cameras."""

import math

import torch
from torch.nn import functional

from .layers import linear, mlp

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
CENTER_FREQUENCIES = (1.0, 2.0, 4.0, 8.0)  # times pi


def plucker_rays(c2w, intrinsics, height, width):
    """Returns the rays [B, V, 6, H, W] of c2w [B, V, 4, 4] and intrinsics [B, V, 3, 3], with channels (o x dir, dir).

    dir = normalize(R ((j + 0.5 - cx) / fx, (i + 0.5 - cy) / fy, 1)),  o = camera center.
    """
    direction = pixel_directions(c2w, intrinsics, height, width)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    origin = c2w[..., None, None, :3, 3].expand_as(direction)
    moment = torch.linalg.cross(origin, direction)
    return torch.cat([moment, direction], dim=-1).movedim(-1, 2)


def pixel_directions(c2w, intrinsics, height, width):
    """Returns the world directions of the pixels, [B, V, H, W, 3], with length 1 along the camera's axis."""
    j = torch.arange(width, dtype=c2w.dtype, device=c2w.device) + 0.5
    i = torch.arange(height, dtype=c2w.dtype, device=c2w.device) + 0.5
    fx, fy = intrinsics[..., 0, 0, None], intrinsics[..., 1, 1, None]
    cx, cy = intrinsics[..., 0, 2, None], intrinsics[..., 1, 2, None]
    x = ((j - cx) / fx)[..., None, :].expand(*c2w.shape[:2], height, width)
    y = ((i - cy) / fy)[..., :, None].expand(*c2w.shape[:2], height, width)

    in_camera = torch.stack([x, y, torch.ones_like(x)], dim=-1)  # [B, V, H, W, 3]
    return torch.einsum("bvrc,bvhwc->bvhwr", c2w[..., :3, :3], in_camera)


def center_features(center):
    """Encodes centers o [..., 3] as [..., 27]: o, sin(pi f o) for all f, cos(pi f o) for all f; frequency-major."""
    sines = [torch.sin(math.pi * f * center) for f in CENTER_FREQUENCIES]
    cosines = [torch.cos(math.pi * f * center) for f in CENTER_FREQUENCIES]
    return torch.cat([center, *sines, *cosines], dim=-1)


def camera_code(params, c2w, intrinsics, height, width):
    """Returns a code per view, [B, V, ray width]: W [MLP(log fx/W, log fy/H, cx/W, cy/H) ; features of the center]."""
    features = torch.stack(
        [
            torch.log(intrinsics[..., 0, 0] / width),
            torch.log(intrinsics[..., 1, 1] / height),
            intrinsics[..., 0, 2] / width,
            intrinsics[..., 1, 2] / height,
        ],
        dim=-1,
    )
    hidden = functional.gelu(mlp(params, "view_pe.k_mlp.0", "view_pe.k_mlp.2", features))
    return linear(params, "view_pe.proj", torch.cat([hidden, center_features(c2w[..., :3, 3])], dim=-1))


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


def ray_tokens(params, c2w, intrinsics, height, width, patch, with_camera_code):
    """Embeds rays and camera codes. Returns [B, V, P, ray width]; all patches of a view have the same camera code."""
    rays = plucker_rays(c2w, intrinsics, height, width)
    tokens = linear(params, "ray_patch_embeds.1", patchify(rays, patch))
    if with_camera_code:
        tokens = tokens + camera_code(params, c2w, intrinsics, height, width)[:, :, None]
    return tokens


def view_tokens(config, params, images, c2w, intrinsics):
    """Returns tokens [B, V, P, ray width + RGB width]. config["camera_code"] false is the ablation "Plücker only"."""
    height, width = images.shape[-2:]
    patch = config["patch_size"]
    ray = ray_tokens(params, c2w, intrinsics, height, width, patch, config["camera_code"])
    return torch.cat([ray, rgb_tokens(params, images, patch)], dim=-1)
