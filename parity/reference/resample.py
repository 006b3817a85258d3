"""Resizing as in Pillow: Lanczos with three lobes, rows first, rounded to 8 bits after each pass."""

import math

import torch

LOBES = 3.0


def lanczos(x):
    if x == 0.0:
        return 1.0
    if abs(x) >= LOBES:
        return 0.0
    return LOBES * math.sin(math.pi * x) * math.sin(math.pi * x / LOBES) / (math.pi * x) ** 2


def weights(inputs, start, extent, outputs):
    """Returns weights [outputs, inputs], float64, to resize `extent` input pixels from `start` to `outputs` pixels."""
    scale = extent / outputs
    stretch = max(scale, 1.0)
    found = torch.zeros(outputs, inputs, dtype=torch.float64)
    for output in range(outputs):
        centre = start + (output + 0.5) * scale
        low = max(int(centre - LOBES * stretch + 0.5), 0)
        high = min(int(centre + LOBES * stretch + 0.5), inputs)
        row = torch.tensor([lanczos((k + 0.5 - centre) / stretch) for k in range(low, high)], dtype=torch.float64)
        found[output, low:high] = row / row.sum()
    return found


def to_levels(values):
    return torch.floor(values + 0.5).clamp(0.0, 255.0)


def resample(image, region, height, width):
    """Resizes a region (left, top, width, height) of an image [H, W, 3] to [3, height, width], float64.

    Input and output are levels from 0 to 255.
    """
    left, top, region_width, region_height = region
    planes = image.double().movedim(-1, 0)
    across = weights(image.shape[1], left, region_width, width)
    down = weights(image.shape[0], top, region_height, height)
    rows = to_levels(planes @ across.T)
    return to_levels(down @ rows)
