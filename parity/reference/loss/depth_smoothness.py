"""Edge-aware depth smoothness loss: penalizes depth differences where the photo is smooth."""

import torch

EDGE = 10.0


def depth_smoothness(depth, photo):
    """Returns the loss of depth [..., H, W], 0 at pixels without depth, and photo [..., 3, H, W].

    The loss is the mean over all pairs of adjacent pixels of 2 |a - b| / (a + b) exp(-10 |g - h|), where a and b are
    their depths and g and h their grey levels; it is 0 for pairs with a = 0 or b = 0.
    """
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
