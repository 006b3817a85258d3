"""Detection of pixels where the rendered image is discontinuous in the Gaussians' parameters.

A pixel is doubtful if an alpha is within `margin` (relative) of 1/255 or of the cap 0.999, a transmittance is within
`margin` of 1e-4, or the depths of two Gaussians that both contribute to it differ by less than a hundredth of `margin`
without being equal. Rounding may then decide, and neither the pixel nor its gradient can be compared.
"""

import torch

from ..reference import splat

MOST_TRIES = 100  # maximum number of attempts to draw inputs without doubtful pixels or close calls


def doubtful_pixels(config, inputs, margin):
    """Returns the mask of doubtful pixels, bool [B, C, H, W], for the arrays of a rasterizer request."""
    scene = {name: torch.tensor(array).double() for name, array in inputs.items()}
    height, width = config["height"], config["width"]
    batch, cameras = scene["w2c"].shape[:2]
    doubtful = torch.zeros(batch, cameras, height * width, dtype=torch.bool)
    for b in range(batch):
        for c in range(cameras):
            means, opacities = scene["means"][b], scene["opacities"][b]
            projected = splat.project(
                means,
                scene["scales"][b],
                scene["quaternions"][b],
                scene["w2c"][b, c],
                scene["intrinsics"][b, c],
                width,
                height,
                config["eps2d"],
                config["antialiased"],
            )
            opacities = opacities * projected["compensation"]
            doubtful[b, c] = doubtful_in_view(
                projected, opacities, splat.pixel_centres(width, height, torch.float64), margin
            )
    return doubtful.reshape(batch, cameras, height, width).numpy()


def doubtful_in_view(projected, opacities, pixels, margin):
    """Returns the mask of doubtful pixels of one view, bool [Q], by the rules of splat.composite."""
    order = torch.argsort(projected["depth"], stable=True)
    order = order[projected["visible"][order]]
    depth = projected["depth"][order]
    dx, dy = (projected["mean2d"][order][:, None] - pixels[None]).unbind(-1)
    a, b, c = (projected["conic"][order][:, k, None] for k in range(3))
    alpha = opacities[order][:, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)

    def near(value, threshold):
        return (value / threshold - 1.0).abs() < margin

    reaches = alpha >= splat.SMALLEST_ALPHA
    passed = torch.where(reaches, 1.0 - alpha.clamp(max=splat.LARGEST_ALPHA), 1.0)
    after = torch.cumprod(passed, dim=0)
    goes_on = torch.cat([torch.ones_like(after[:1]), after[:-1]]) > splat.SMALLEST_TRANSMITTANCE * (1.0 - margin)

    steps = near(alpha, splat.SMALLEST_ALPHA) | near(alpha, splat.LARGEST_ALPHA)
    steps |= near(after, splat.SMALLEST_TRANSMITTANCE)
    doubtful = (steps & goes_on).any(0)

    gap = depth[1:] - depth[:-1]
    unordered = (gap > 0) & (gap < 0.01 * margin * depth[1:])
    both = reaches[1:] & reaches[:-1] & goes_on[1:]
    return doubtful | (both & unordered[:, None]).any(0)
