"""Where a picture is a step function of its Gaussians, and a network's gradient one of its picture.

A pixel is doubtful when an alpha lies within `margin` (relative) of 1/255 or of the cap 0.999, a transmittance within
`margin` of 1e-4, or the depths of two Gaussians that both reach it within a hundredth of `margin` of each other without
being equal: rounding may then decide, and neither the pixel nor its gradient can be compared.
"""

import torch
from reference import splat
from reference.loss import lpips, vgg19

MOST_TRIES = 100  # to draw one without a doubt


def doubtful_pixels(config, inputs, margin):
    """inputs: arrays of a rasterizer request -> bool [B, C, H, W]."""
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
            )
            doubtful[b, c] = of_view(projected, opacities, splat.pixel_centres(width, height, torch.float64), margin)
    return doubtful.reshape(batch, cameras, height, width).numpy()


def of_view(projected, opacities, pixels, margin):
    """-> bool [Q]. The rules are those of splat.composite."""
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


def closest_call(network, params, pictures):
    """How near the features of LPIPS come to another gradient: the smallest number before a ReLU, or difference between
    a pooling window's largest two, as a share of the layer's standard deviation. Arrays of a request."""
    params = {name: torch.tensor(value).double() for name, value in params.items()}
    found = lpips.convolutions(network, params, torch.tensor(pictures).double())
    pooled = [row[-1][0] for row in lpips.NETWORKS[network][:-1]]
    closest = torch.inf
    for name, x in found.items():
        calls = [x.abs().min()]
        if name in pooled:
            size = lpips.POOLING[network]
            first, second = torch.relu(x).unfold(2, size, 2).unfold(3, size, 2).flatten(4).topk(2).values.unbind(-1)
            calls.append((first - second)[first > 0.0].min())
        closest = min(closest, min(calls).item() / x.std().item())
    return closest


def closest_call_of_vgg19(params, picture, truth):
    """The same of VGG-19's loss: before a ReLU, and between the features that are compared, where not both are zero."""
    params = {name: torch.tensor(value).double() for name, value in params.items()}
    (_, ours), (_, theirs) = (vgg19.convolutions(params, torch.tensor(t).double()) for t in (picture, truth))
    closest = torch.inf
    for place, x in ours.items():
        calls = [x.abs().min()]
        if place in vgg19.FACTORS:
            difference = (torch.relu(x) - torch.relu(theirs[place])).abs()
            calls.append(difference[difference > 0.0].min())
        closest = min(closest, min(calls).item() / x.std().item())
    return closest
