"""LPIPS (Zhang et al. 2018): the distance between the features of two images in a trained network."""

import torch

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


def pool(network, x):
    return torch.nn.functional.max_pool2d(x, POOLING[network], stride=2)


def convolutions(network, params, pictures):
    """Returns the output of each convolution by name, before its ReLU, for images [B, 3, H, W] in [0, 1]."""
    shift, scale = (torch.tensor(c, dtype=pictures.dtype).reshape(3, 1, 1) for c in (SHIFT, SCALE))
    x = ((2.0 * pictures - 1.0) - shift) / scale
    found = {}
    for row in NETWORKS[network]:
        if found:
            x = pool(network, x)
        for name, _, _, stride, padding in row:
            weight, bias = params[f"{name}.weight"], params[f"{name}.bias"]
            found[name] = torch.nn.functional.conv2d(x, weight, bias, stride, padding)
            x = torch.relu(found[name])
    return found


def unit(x):
    """Returns x / (|x| + eps) over the channels. |x| has no derivative at 0, but the ReLU before blocks gradients."""
    return x / (torch.linalg.vector_norm(x, dim=1, keepdim=True) + EPSILON)


def lpips(network, params, picture, truth):
    """Returns the distances [B] of images [B, 3, H, W]: sum over layers of mean over pixels of sum over channels of
    w (a - b)^2."""
    ours, theirs = convolutions(network, params, picture), convolutions(network, params, truth)
    total = 0.0
    for i, name in enumerate(COMPARED[network]):
        difference = unit(torch.relu(ours[name])) - unit(torch.relu(theirs[name]))
        weighted = params[f"lin{i}.weight"] * difference**2
        total = total + weighted.sum(dim=1).mean(dim=(1, 2))
    return total
