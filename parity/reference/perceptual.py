"""Losses that compare the features of two images in a trained network: LPIPS, and the one of VGG-19."""

import torch
import torch.nn.functional as F

# ---- LPIPS (Zhang et al. 2018) ---------------------------------------------------------------------------------------

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
EPSILON = 1e-10

# Convolutions as (name, output channels, kernel size, stride, padding); a max pooling separates the rows.
NETWORKS = {
    "lpips_vgg": [
        [("conv1_1", 64, 3, 1, 1), ("conv1_2", 64, 3, 1, 1)],
        [("conv2_1", 128, 3, 1, 1), ("conv2_2", 128, 3, 1, 1)],
        [("conv3_1", 256, 3, 1, 1), ("conv3_2", 256, 3, 1, 1), ("conv3_3", 256, 3, 1, 1)],
        [("conv4_1", 512, 3, 1, 1), ("conv4_2", 512, 3, 1, 1), ("conv4_3", 512, 3, 1, 1)],
        [("conv5_1", 512, 3, 1, 1), ("conv5_2", 512, 3, 1, 1), ("conv5_3", 512, 3, 1, 1)],
    ],
    "lpips_alex": [
        [("conv1", 64, 11, 4, 2)],
        [("conv2", 192, 5, 1, 2)],
        [("conv3", 384, 3, 1, 1), ("conv4", 256, 3, 1, 1), ("conv5", 256, 3, 1, 1)],
    ],
}
COMPARED = {
    "lpips_vgg": ("conv1_2", "conv2_2", "conv3_3", "conv4_3", "conv5_3"),
    "lpips_alex": ("conv1", "conv2", "conv3", "conv4", "conv5"),
}
POOLING = {"lpips_vgg": 2, "lpips_alex": 3}  # window size; the stride is 2


def unit(x):
    """Returns x / (|x| + eps) over the channels. |x| has no derivative at 0, but the ReLU before blocks gradients."""
    return x / (torch.linalg.vector_norm(x, dim=1, keepdim=True) + EPSILON)


def lpips_features(network, params, images):
    """Returns the compared features, divided by their norms, of images [B, 3, H, W] in [0, 1]."""
    shift, scale = (torch.tensor(c, dtype=images.dtype).reshape(3, 1, 1) for c in (SHIFT, SCALE))
    x, found = ((2.0 * images - 1.0) - shift) / scale, []
    for index, row in enumerate(NETWORKS[network]):
        if index > 0:
            x = F.max_pool2d(x, POOLING[network], stride=2)
        for name, _, _, stride, padding in row:
            x = torch.relu(F.conv2d(x, params[f"{name}.weight"], params[f"{name}.bias"], stride, padding))
            if name in COMPARED[network]:
                found.append(unit(x))
    return found


def lpips(network, params, image, ground_truth):
    """Returns the distances [B] of images [B, 3, H, W]: sum over layers of mean over pixels of sum over channels of
    w (a - b)^2."""
    pairs = zip(lpips_features(network, params, image), lpips_features(network, params, ground_truth), strict=True)
    return sum((params[f"lin{i}.weight"] * (a - b) ** 2).sum(1).mean((1, 2)) for i, (a, b) in enumerate(pairs))


# ---- VGG-19 (Simonyan & Zisserman 2015) with average pooling -----------------------------------------------------------

MEANS = (123.68, 116.779, 103.939)
# Blocks between poolings: indices of the convolutions in torchvision's `features`, and their output channels.
BLOCKS = [
    ((0, 2), 64),
    ((5, 7), 128),
    ((10, 12, 14, 16), 256),
    ((19, 21, 23, 25), 512),
    ((28, 30), 512),
]
# Indices of the convolutions whose outputs (after ReLU) are compared, and the weights of their mean differences.
FACTORS = {2: 1 / 2.6, 7: 1 / 4.8, 12: 1 / 3.7, 21: 1 / 5.6, 30: 10 / 1.5}


def vgg19_features(params, images):
    """Returns the compared features of images [B, 3, H, W] in [0, 1], each with its weight: the network's input, and layers."""
    x = 255.0 * images - torch.tensor(MEANS, dtype=images.dtype).reshape(3, 1, 1)
    found = [(1.0, x)]
    for block, (places, _) in enumerate(BLOCKS):
        if block > 0:
            x = F.avg_pool2d(x, 2)
        for place in places:
            x = torch.relu(F.conv2d(x, params[f"features.{place}.weight"], params[f"features.{place}.bias"], padding=1))
            if place in FACTORS:
                found.append((FACTORS[place], x))
    return found


def vgg19(params, image, ground_truth):
    """Returns the loss of two images [B, 3, H, W]: the weighted sum of the mean absolute differences."""
    pairs = zip(vgg19_features(params, image), vgg19_features(params, ground_truth), strict=True)
    return sum(factor * (ours - theirs).abs().mean() for (factor, ours), (_, theirs) in pairs) / 255.0


def perceptual(kind, inputs, image, ground_truth):
    """Returns the mean loss of two renderings [2 B, V, 3, H, W] of images [B, V, 3, H, W]; `inputs` has the weights."""
    ground_truth = ground_truth.flatten(0, 1)
    halves = [half.flatten(0, 1) for half in image.chunk(2)]
    if kind == "vgg19":
        return sum(vgg19(inputs, half, ground_truth) for half in halves) / 2.0
    return sum(lpips(kind, inputs, half, ground_truth).mean() for half in halves) / 2.0
