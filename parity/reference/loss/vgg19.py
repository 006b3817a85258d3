"""The perceptual loss `vgg19`: features of VGG-19 (Simonyan & Zisserman 2015) with average pooling."""

import torch

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


def convolutions(params, pictures):
    """Returns the network's input, and the output of each convolution by index, before its ReLU.

    Images are [B, 3, H, W] in [0, 1].
    """
    start = 255.0 * pictures - torch.tensor(MEANS, dtype=pictures.dtype).reshape(3, 1, 1)
    x, found = start, {}
    for places, _ in BLOCKS:
        if found:
            x = torch.nn.functional.avg_pool2d(x, 2)
        for place in places:
            weight, bias = params[f"features.{place}.weight"], params[f"features.{place}.bias"]
            found[place] = torch.nn.functional.conv2d(x, weight, bias, padding=1)
            x = torch.relu(found[place])
    return start, found


def vgg19(params, picture, truth):
    """Returns the scalar loss of two images [..., 3, H, W]."""
    (ours, our_layers), (theirs, their_layers) = (convolutions(params, t.flatten(0, -4)) for t in (picture, truth))
    total = (ours - theirs).abs().mean()
    for place, factor in FACTORS.items():
        total = total + factor * (torch.relu(our_layers[place]) - torch.relu(their_layers[place])).abs().mean()
    return total / 255.0
