"""Camera inputs of the tokens: a Plücker ray for every pixel, and a camera code for every view."""

import math

import torch

from .layers import gelu, linear

CENTRE_FREQUENCIES = (1.0, 2.0, 4.0, 8.0)  # times pi


def plucker_rays(c2w, intrinsic, height, width):
    """Returns the rays [B, V, 6, H, W] of c2w [B, V, 4, 4] and intrinsic [B, V, 3, 3], with channels (o x dir, dir).

    dir = normalize(R ((j + 0.5 - cx) / fx, (i + 0.5 - cy) / fy, 1)),  o = camera centre.
    """
    direction = pixel_directions(c2w, intrinsic, height, width)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    origin = c2w[..., None, None, :3, 3].expand_as(direction)
    moment = torch.linalg.cross(origin, direction)
    return torch.cat([moment, direction], dim=-1).movedim(-1, 2)


def pixel_directions(c2w, intrinsic, height, width):
    """Returns the world directions of the pixels, [B, V, H, W, 3], with length 1 along the camera's axis."""
    j = torch.arange(width, dtype=c2w.dtype, device=c2w.device) + 0.5
    i = torch.arange(height, dtype=c2w.dtype, device=c2w.device) + 0.5
    fx, fy = intrinsic[..., 0, 0, None], intrinsic[..., 1, 1, None]
    cx, cy = intrinsic[..., 0, 2, None], intrinsic[..., 1, 2, None]
    x = ((j - cx) / fx)[..., None, :].expand(*c2w.shape[:2], height, width)
    y = ((i - cy) / fy)[..., :, None].expand(*c2w.shape[:2], height, width)

    in_camera = torch.stack([x, y, torch.ones_like(x)], dim=-1)  # [B, V, H, W, 3]
    return torch.einsum("bvrc,bvhwc->bvhwr", c2w[..., :3, :3], in_camera)


def centre_features(centre):
    """Encodes centres o [..., 3] as [..., 27]: o, sin(pi f o) for all f, cos(pi f o) for all f; frequency-major."""
    sines = [torch.sin(math.pi * f * centre) for f in CENTRE_FREQUENCIES]
    cosines = [torch.cos(math.pi * f * centre) for f in CENTRE_FREQUENCIES]
    return torch.cat([centre, *sines, *cosines], dim=-1)


def camera_code(params, c2w, intrinsic, height, width):
    """Returns a code per view, [B, V, ray width]: W [MLP(log fx/W, log fy/H, cx/W, cy/H) ; features of the centre]."""
    features = torch.stack(
        [
            torch.log(intrinsic[..., 0, 0] / width),
            torch.log(intrinsic[..., 1, 1] / height),
            intrinsic[..., 0, 2] / width,
            intrinsic[..., 1, 2] / height,
        ],
        dim=-1,
    )
    hidden = gelu(linear(params, "view_pe.k_mlp.0", features))
    hidden = gelu(linear(params, "view_pe.k_mlp.2", hidden))
    return linear(params, "view_pe.proj", torch.cat([hidden, centre_features(c2w[..., :3, 3])], dim=-1))
