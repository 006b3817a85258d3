"""Where the gradient of a network of convolutions is a step function of its picture: a number before a ReLU changes its
sign, another one becomes the largest of a pooling window, or a feature the larger of two that are compared. Within
rounding either side is right.

A close call is judged by what the reference says when that number is put on the other side. An answer has to agree,
within the tolerance, with what the reference says for some choice of sides.
"""

from dataclasses import dataclass

import numpy as np
import torch
from reference.loss import lpips, vgg19
from torch.overrides import TorchFunctionMode

from .compare import norm

# Of a layer's standard deviation: twice what rounding on a CPU moves numbers by, and what a GPU's other algorithms may.
ON_CPU = 5e-6
ON_GPU = 1e-4
SWEEPS = 3  # over all close calls, to find the sides on which an answer has them


@dataclass(frozen=True)
class Call:
    """`amount`, added to number `index` (flat) of what the twin's convolution number `convolution` puts out, turns a
    decision."""

    share: float  # how close it is, of the layer's standard deviation
    convolution: int
    index: int
    amount: float


class Turned(TorchFunctionMode):
    """The twin computes within this as if the numbers of `calls` lay on their other sides."""

    def __init__(self, calls):
        super().__init__()
        self.calls, self.convolution = calls, -1

    def __torch_function__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        if function is torch.conv2d or function is torch.nn.functional.conv2d:
            self.convolution += 1
            here = [call for call in self.calls if call.convolution == self.convolution]
            if here:
                offsets = torch.zeros(result.numel(), dtype=result.dtype)
                for call in here:
                    offsets[call.index] += call.amount
                result = result + offsets.reshape(result.shape)
        return result


def before_relu(x):
    """-> distances, flat indices, amounts."""
    return x.abs().flatten(), torch.arange(x.numel()), -2.0 * x.flatten()


def in_windows(x, size):
    """Of pooling windows that hold two numbers, between the largest."""

    def windows(t):
        return t.unfold(2, size, 2).unfold(3, size, 2).flatten(4)

    indices = windows(torch.arange(x.numel(), dtype=torch.float64).reshape(x.shape)).long()
    (first, second), places = (t.unbind(-1) for t in windows(torch.relu(x)).topk(2))
    index = indices.gather(-1, places[1].unsqueeze(-1)).squeeze(-1)
    both = second > 0.0
    gap, index = (first - second)[both], index[both]
    return gap, index, 2.0 * gap


def between_features(x, other):
    """Where not both are zero. A feature of zero lets no gradient through, on whichever side it is."""
    difference = (torch.relu(x) - torch.relu(other)).flatten()
    index = difference.nonzero().squeeze(1)
    return difference[index].abs(), index, torch.where(x.flatten()[index] > 0.0, -2.0 * difference[index], 0.0)


def calls_within(margin, decisions):
    """decisions: (convolution, x, (distances, indices, amounts)). -> the calls closer than `margin`, of each number the
    closest."""
    found = {}
    for convolution, x, (distances, indices, amounts) in decisions:
        shares = distances / x.std()
        close = ((shares < margin) & (amounts != 0.0)).nonzero().squeeze(1)
        for share, index, amount in zip(*(t[close].tolist() for t in (shares, indices, amounts)), strict=True):
            call = Call(share, convolution, index, amount)
            found[convolution, index] = min(call, found.get((convolution, index), call), key=lambda call: call.share)
    return sorted(found.values(), key=lambda call: call.share)


def closest(decisions):
    """The share of the closest call of all, turned or not."""
    shares = ((distances / x.std()).min().item() for _, x, (distances, *_) in decisions if len(distances))
    return min(shares, default=np.inf)


def doubles(arrays):
    return {name: torch.tensor(value).double() for name, value in arrays.items()}


def decisions_of_lpips(network, params, pictures):
    """`pictures` [B, 3, H, W] in the order in which the twin looks at them."""
    params, pooled = doubles(params), [row[-1][0] for row in lpips.NETWORKS[network][:-1]]
    convolution = 0
    for picture in pictures:
        for name, x in lpips.convolutions(network, params, torch.tensor(picture).double()).items():
            yield convolution, x, before_relu(x)
            if name in pooled:
                yield convolution, x, in_windows(x, lpips.POOLING[network])
            convolution += 1


def decisions_of_vgg19(params, pairs):
    """`pairs` of a picture and what it is compared with, which takes no gradient, in the order in which the twin looks
    at them."""
    params, convolution = doubles(params), 0
    for pair in pairs:
        pictures = (torch.tensor(t).double().flatten(0, -4) for t in pair)
        (_, ours), (_, theirs) = (vgg19.convolutions(params, t) for t in pictures)
        for place, x in ours.items():
            yield convolution, x, before_relu(x)
            if place in vgg19.FACTORS:
                yield convolution, x, between_features(x, theirs[place])
            convolution += 1
        convolution += len(theirs)


def settled(answer, expected, calls, turned):
    """`turned(calls)` gives the reference's gradients with these calls on their other sides. -> what is expected of an
    answer that has decided some of `calls` otherwise, and how many it has: those that bring the two together."""
    gradients = [name for name in expected if name.startswith("grad.") and name in answer]
    lengths = {name: norm(expected[name]) or 1.0 for name in gradients}

    def distance(other):
        apart = (norm(np.asarray(answer[name], np.float64) - other[name]) / lengths[name] for name in gradients)
        return sum(share**2 for share in apart)

    best, chosen = expected, frozenset()
    for _ in range(SWEEPS):
        before = chosen
        for call in calls:
            other = expected | turned(chosen ^ {call})
            if distance(other) < distance(best):
                best, chosen = other, chosen ^ {call}
        if chosen == before:
            break
    return best, len(chosen)
