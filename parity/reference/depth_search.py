"""Plane sweep: the correlation of a photo with others that are warped onto planes at several depths; and semi-global matching."""

import torch
import torch.nn.functional as F

PATCH = 9
LEAST_VARIANCE = 1e-4
LEAST_WEIGHT = 0.5
LEAST_MASS = 0.25
CLOSE = 1e-3  # distance from a threshold within which rounding may decide

MATCHED_LEAST_VARIANCE, MATCHED_CLOSE = 1e-5, 2e-5
STEP_COST, JUMP_COST, EDGE_RATE = 0.1, 3.0, 10.0
FAR_BONUS = 0.1
HALF_MARGIN = 0.05
DIRECTIONS = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]


def patch_means(t):
    """Returns the mean over the patch around each pixel, without the part outside the image: [..., H, W] to [..., H, W]."""
    flat = t.reshape(-1, 1, *t.shape[-2:])
    return F.avg_pool2d(flat, PATCH, 1, PATCH // 2, count_include_pad=False).reshape(t.shape)


def sample(image, x, y):
    """Returns the values of image [H, W] at continuous coordinates x and y; those at its border are repeated outside."""
    height, width = image.shape
    grid = torch.stack((2.0 * x / width - 1.0, 2.0 * y / height - 1.0), -1)
    images = image.expand(len(x), 1, height, width)
    return F.grid_sample(images, grid, padding_mode="border", align_corners=False).squeeze(1)


def correlations(gray, weight, other, other_weight, to_pixels, inverse_depths, least_variance, limit):
    """Returns the correlation of gray [H, W] with another photo on each plane, and a mask of close calls, [planes, H, W] each.

    The weights are None if every pixel counts. A patch's correlation is -1 where the pixel isn't shown or has too
    little weight. A call is close within `limit` of a threshold.
    """
    height, width = gray.shape
    rows, columns = (torch.arange(side, dtype=gray.dtype) + 0.5 for side in (height, width))
    x, y, z = (
        row[0] * columns + row[1] * rows[:, None] + row[2] + row[3] * inverse_depths[:, None, None] for row in to_pixels
    )
    x, y = x / z, y / z
    shown = (z > 0.0) & (x >= 0.0) & (x <= other.shape[1]) & (y >= 0.0) & (y <= other.shape[0])
    limits = [z, x, x - other.shape[1], y, y - other.shape[0]]
    close = torch.stack([limit.abs() for limit in limits]).amin(0) < limit
    own, seen = gray.expand_as(x), sample(other, x, y)
    product = torch.ones_like(seen)
    if weight is not None:
        product = product * weight
    if other_weight is not None:
        product = product * sample(other_weight, x, y)
    mass = patch_means(product)
    close |= ((product - LEAST_WEIGHT).abs() < limit) | ((mass - LEAST_MASS).abs() < limit)

    def mean(t):
        return patch_means(product * t) / mass.clamp_min(LEAST_MASS)

    def variance(t):
        return mean(t * t) - mean(t) ** 2 + least_variance

    covariance = mean(own * seen) - mean(own) * mean(seen)
    counts = shown & (product >= LEAST_WEIGHT) & (mass >= LEAST_MASS)
    return torch.where(counts, covariance / (variance(own) * variance(seen)).sqrt(), -1.0), close


def all_correlations(gray, others, to_pixels, step, planes, weight, other_weights, least_variance, limit):
    """Returns the `correlations` with all other photos, [others, planes, H, W]."""
    inverse_depths = step * torch.arange(planes, dtype=gray.dtype)
    other_weights = [None] * len(others) if other_weights is None else other_weights
    compared = [
        correlations(gray, weight, other, other_weight, matrix, inverse_depths, least_variance, limit)
        for other, other_weight, matrix in zip(others, other_weights, to_pixels, strict=True)
    ]
    stacked, close = zip(*compared, strict=True)
    return torch.stack(stacked), torch.stack(close)


def search(gray, others, to_pixels, step, planes, weight=None, other_weights=None):
    """Returns each pixel's best inverse depth, the correlation there, and a mask of the pixels where rounding may decide, [H, W] each."""
    photos = gray, others, to_pixels, step, planes, weight, other_weights
    stacked, close = all_correlations(*photos, LEAST_VARIANCE, CLOSE)
    better_half = stacked.topk(max(len(others) // 2, 1), 0).values.mean(0)
    (first, second), planes_of = better_half.topk(2, 0)
    # Planes without a photo that shows the pixel are equal; the first of them counts.
    plane = torch.where(first > -1.0, planes_of[0], 0)
    doubtful = close.flatten(0, 1).any(0) | ((first - second < CLOSE) & (first > -1.0))
    return plane * step, first, doubtful


def path_costs(costs, gray, dy, dx):
    """Returns the costs [planes, H, W] along the paths in direction (dy, dx)."""
    if dy == 0:
        return path_costs(costs.transpose(1, 2), gray.T, dx, 0).transpose(1, 2)
    if dy < 0:
        return path_costs(costs.flip(1), gray.flip(0), -dy, dx).flip(1)
    columns = torch.arange(gray.shape[1]) - dx
    begins = (columns < 0) | (columns >= gray.shape[1])
    rows = [costs[:, 0]]
    for here, gray_here, gray_before in zip(costs.unbind(1)[1:], gray[1:], gray[:-1], strict=True):
        before = rows[-1].roll(dx, 1)
        jump = (JUMP_COST / (1.0 + EDGE_RATE * (gray_here - gray_before.roll(dx)).abs())).clamp_min(STEP_COST)
        least = before.amin(0)
        beside = F.pad(before, (0, 0, 1, 1), value=torch.inf)
        stepped = torch.minimum(beside[:-2], beside[2:]) + STEP_COST
        added = torch.minimum(torch.minimum(before, stepped), least + jump) - least
        rows.append(torch.where(begins, here, here + added))
    return torch.stack(rows, 1)


def match_semi_globally(gray, others, to_pixels, step, planes, weight=None, other_weights=None):
    """Returns each pixel's inverse depth by semi-global matching, how sure it is, and a mask of the pixels where rounding may decide.

    One pixel's visibility has an effect on all others, so if it is close to a threshold, all may be wrong.
    """
    photos = gray, others, to_pixels, step, planes, weight, other_weights
    stacked, close = all_correlations(*photos, MATCHED_LEAST_VARIANCE, MATCHED_CLOSE)
    costs = 1.0 - stacked.clamp_min(0.0).topk(max(len(others) // 2, 1), 0).values.mean(0)
    variance = patch_means(gray * gray) - patch_means(gray) ** 2 + MATCHED_LEAST_VARIANCE
    costs[0] -= FAR_BONUS * MATCHED_LEAST_VARIANCE / variance
    means = sum(path_costs(costs, gray, dy, dx) for dy, dx in DIRECTIONS) / len(DIRECTIONS)
    least, best = means.min(0)
    index = torch.arange(planes)[:, None, None]
    margin = means.masked_fill((index - best).abs() <= 1, torch.inf).amin(0) - least
    inner = (best > 0) & (best < planes - 1)
    before, after = (means.gather(0, (best + by).clamp(0, planes - 1)[None])[0] for by in (-1, 1))
    vertex = 0.5 * (before - after) / torch.where(inner, before - 2.0 * least + after, 1.0)
    plane = best + torch.where(inner, vertex, 0.0)
    confidence = (1.0 - least).clamp(0.0, 1.0) / (1.0 + HALF_MARGIN / margin)
    second = means.masked_fill(index == best, torch.inf).amin(0)
    return plane * step, confidence, close.any() | (second - least < CLOSE)
