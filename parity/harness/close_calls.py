"""Close calls: discontinuities of a convolutional network's gradient that rounding can decide either way.

The gradient is a step function of the image where a value before a ReLU changes its sign, where another value becomes
the maximum of a pooling window, or where the sign of the difference of two compared features changes. Within rounding,
either side is correct. The result of the program must agree, within the tolerance, with the reference for some choice
of sides; for the other side of a close call, the reference is computed with that value moved across the threshold.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch.overrides import TorchFunctionMode

from ..reference.loss import lpips, vgg19
from .compare import norm

# Margins relative to a layer's standard deviation: twice the effect of rounding on a CPU, and the possible effect of
# the other algorithms on a GPU.
ON_CPU = 5e-6
ON_GPU = 1e-4
SWEEPS = 3  # passes over all close calls to find the sides that the program chose


@dataclass(frozen=True)
class Call:
    """A close call: adding `amount` to element `index` (flat) of the output of the reference's convolution number
    `convolution` reverses a decision."""

    share: float  # distance from the threshold, relative to the layer's standard deviation
    convolution: int
    index: int
    amount: float


class FlippedDecisions(TorchFunctionMode):
    """Context in which the reference computes with the values of `calls` moved across their thresholds."""

    def __init__(self, calls):
        super().__init__()
        self.calls, self.convolution = calls, -1

    def __torch_function__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        if function is torch.conv2d:
            self.convolution += 1
            here = [call for call in self.calls if call.convolution == self.convolution]
            if here:
                offsets = torch.zeros(result.numel(), dtype=result.dtype)
                for call in here:
                    offsets[call.index] += call.amount
                result = result + offsets.reshape(result.shape)
        return result


def relu_decisions(x):
    """Returns the decisions of a ReLU on x: distances, flat indices, amounts."""
    return x.abs().flatten(), torch.arange(x.numel()), -2.0 * x.flatten()


def pooling_decisions(x, size):
    """Returns the decisions of max pooling between the two largest values of each window with two positive values."""

    def windows(t):
        return t.unfold(2, size, 2).unfold(3, size, 2).flatten(4)

    indices = windows(torch.arange(x.numel(), dtype=torch.float64).reshape(x.shape)).long()
    (first, second), places = (t.unbind(-1) for t in windows(torch.relu(x)).topk(2))
    index = indices.gather(-1, places[1].unsqueeze(-1)).squeeze(-1)
    both = second > 0.0
    gap, index = (first - second)[both], index[both]
    return gap, index, 2.0 * gap


def difference_decisions(x, other):
    """Returns the decisions on the sign of the difference of two features that are not both zero.

    The amount is 0 for a feature of zero, because no gradient passes through it on either side.
    """
    difference = (torch.relu(x) - torch.relu(other)).flatten()
    index = difference.nonzero().squeeze(1)
    return difference[index].abs(), index, torch.where(x.flatten()[index] > 0.0, -2.0 * difference[index], 0.0)


def calls_within(margin, decisions):
    """Returns the calls closer than `margin`, at most the closest one per element, sorted by distance.

    `decisions` are (convolution, x, (distances, indices, amounts)).
    """
    found = {}
    for convolution, x, (distances, indices, amounts) in decisions:
        shares = distances / x.std()
        close = ((shares < margin) & (amounts != 0.0)).nonzero().squeeze(1)
        for share, index, amount in zip(*(t[close].tolist() for t in (shares, indices, amounts)), strict=True):
            call = Call(share, convolution, index, amount)
            found[convolution, index] = min(call, found.get((convolution, index), call), key=lambda call: call.share)
    return sorted(found.values(), key=lambda call: call.share)


def closest(decisions):
    """Returns the distance of the closest decision, relative to its layer's standard deviation."""
    shares = ((distances / x.std()).min().item() for _, x, (distances, *_) in decisions if len(distances))
    return min(shares, default=np.inf)


def doubles(arrays):
    return {name: torch.tensor(value).double() for name, value in arrays.items()}


def decisions_of_lpips(network, params, pictures):
    """Yields the decisions of an LPIPS network on `pictures` [B, 3, H, W], in the order in which the reference runs."""
    params, pooled = doubles(params), [row[-1][0] for row in lpips.NETWORKS[network][:-1]]
    convolution = 0
    for picture in pictures:
        for name, x in lpips.convolutions(network, params, torch.tensor(picture).double()).items():
            yield convolution, x, relu_decisions(x)
            if name in pooled:
                yield convolution, x, pooling_decisions(x, lpips.POOLING[network])
            convolution += 1


def decisions_of_vgg19(params, pairs):
    """Yields the decisions of VGG-19 on `pairs` of an image and its ground truth, in the order in which the reference
    runs.

    The ground truth takes no gradient.
    """
    params, convolution = doubles(params), 0
    for pair in pairs:
        pictures = (torch.tensor(t).double().flatten(0, -4) for t in pair)
        (_, ours), (_, theirs) = (vgg19.convolutions(params, t) for t in pictures)
        for place, x in ours.items():
            yield convolution, x, relu_decisions(x)
            if place in vgg19.FACTORS:
                yield convolution, x, difference_decisions(x, theirs[place])
            convolution += 1
        convolution += len(theirs)


def resolve_close_calls(answer, expected, calls, flipped):
    """Finds which of `calls` the program decided differently: those that bring the reference closest to its gradients.

    `flipped(calls)` returns the reference's gradients with these calls on their other sides. Returns the expected
    tensors for the chosen sides, and the number of calls that differ.
    """
    gradients = [name for name in expected if name.startswith("grad.") and name in answer]
    lengths = {name: norm(expected[name]) or 1.0 for name in gradients}

    def distance(other):
        apart = (norm(np.asarray(answer[name], np.float64) - other[name]) / lengths[name] for name in gradients)
        return sum(share**2 for share in apart)

    best, chosen, least = expected, frozenset(), distance(expected)
    for _ in range(SWEEPS):
        before = chosen
        for call in calls:
            other = expected | flipped(chosen ^ {call})
            apart = distance(other)
            if apart < least:
                best, chosen, least = other, chosen ^ {call}, apart
        if chosen == before:
            break
    # A program that decides most of them otherwise doesn't round otherwise: it has another threshold.
    if len(chosen) > max(2, len(calls) // 2):
        return expected, 0
    return best, len(chosen)
