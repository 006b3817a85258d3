"""Scene normalization: one canonical frame and scale for all cameras of a scene."""

import torch

ROUNDING = 1e-14  # cameras whose extent relative to their largest coordinate is at most this keep their scale
SMALLEST_DIRECTION = 1e-6  # a mean direction whose norm is at most this is undefined


def unit(v):
    return v / v.norm()


def average_pose(c2w):
    """Returns the mean camera [4, 4] of c2w [C, 4, 4]: columns (right, down, forward), origin at the mean center.

    The columns are those of the first camera if directions cancel out.
    """
    pose = c2w[0].clone()
    pose[:3, 3] = c2w[:, :3, 3].mean(0)
    forward = c2w[:, :3, 2].mean(0)
    right = torch.linalg.cross(c2w[:, :3, 1].mean(0), unit(forward))
    if forward.norm() > SMALLEST_DIRECTION and right.norm() > SMALLEST_DIRECTION:
        forward, right = unit(forward), unit(right)
        pose[:3, :3] = torch.stack([right, unit(torch.linalg.cross(forward, right)), forward], dim=-1)
    return pose


def invert_rigid(pose):
    """Inverts rigid transforms [..., 4, 4]: (R, t) -> (R^T, -R^T t)."""
    rotation_t = pose[..., :3, :3].transpose(-1, -2)
    inverse = torch.zeros_like(pose)
    inverse[..., :3, :3] = rotation_t
    inverse[..., :3, 3:] = -rotation_t @ pose[..., :3, 3:]
    inverse[..., 3, 3] = 1.0
    return inverse


def normalize_scene(c2w):
    """Normalizes c2w [C, 4, 4], all context and target cameras of one scene.

    Returns the normalized c2w [C, 4, 4], its inverse w2c [C, 4, 4] and the scale s:
        T'_i = T_avg^-1 T_i,   s = max_ab |o'_a - o'_b|,   o'_i <- o'_i / s.
    """
    average = average_pose(c2w)
    centered = c2w.clone()
    centered[:, :3, 3] -= average[:3, 3]
    average[:3, 3] = 0.0
    aligned = invert_rigid(average) @ centered
    centers = aligned[:, :3, 3]
    scale = (centers[:, None] - centers[None, :]).norm(dim=-1).max()
    if not torch.isfinite(scale) or scale <= ROUNDING * c2w[:, :3, 3].abs().max():
        scale = torch.ones_like(scale)

    normalized = aligned.clone()
    normalized[:, :3, 3] = centers / scale
    return normalized, invert_rigid(normalized), scale
