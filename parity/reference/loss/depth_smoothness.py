"""How uneven depths are where the photo is even."""

import torch

EDGE = 10.0


def depth_smoothness(depth, photo):
    """depth [..., H, W], 0 where nothing is seen, and photo [..., 3, H, W] -> the mean over all pairs of neighbours of
    2 |a - b| / (a + b) exp(-10 |g - h|), 0 where a or b is."""
    grey = photo.mean(-3)
    total, pairs = depth.sum() * 0.0, 0
    for axis in (-1, -2):
        a, b = (depth.narrow(axis, start, depth.shape[axis] - 1) for start in (0, 1))
        g, h = (grey.narrow(axis, start, grey.shape[axis] - 1) for start in (0, 1))
        seen = (a > 0) & (b > 0)
        uneven = 2.0 * (a - b).abs() / torch.where(seen, a + b, 1.0)
        total = total + torch.where(seen, uneven * torch.exp(-EDGE * (g - h).abs()), 0.0).sum()
        pairs += a.numel()
    return total / max(pairs, 1)
