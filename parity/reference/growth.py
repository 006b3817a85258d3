"""Conversion of the weights of a smaller model to those of a larger one."""

import math

import torch

SPREAD = 0.2
PARAMETERS = 10  # outputs per candidate, the last of which is the opacity logit


def for_smaller_patches(weights, patch, times):
    """Converts patch embedding weights [d, p p C] to patches of a `times` smaller edge, [d, p p C / times²].

    The weight of a pixel is the sum over the pixels of the large patch that it is upscaled to.
    """
    edge = patch // times
    pixels = weights.reshape(len(weights), patch, patch, -1)
    summed = pixels.new_zeros(len(weights), edge, edge, pixels.shape[-1])
    for row in range(times):
        for column in range(times):
            summed = summed + pixels[:, row::times, column::times]
    return summed.flatten(1)


def more_tokens(tokens, noise):
    """Repeats each token of [M, d] n times in place and adds scaled normal noise [n M, d]. Returns [n M, d]."""
    owners = torch.arange(len(noise), device=tokens.device) // (len(noise) // len(tokens))
    deviation = ((tokens - tokens.mean()) ** 2).mean().sqrt()
    return tokens[owners] + SPREAD * deviation * noise


def shared_opacities(bias, copies):
    """Adds logit(1 - 2^(-1/n)) to the opacity biases, with n = `copies`.

    An opacity of one half becomes 1 - 2^(-1/n); n overlapping Gaussians of this opacity have a total of one half.
    """
    each = 1.0 - 0.5 ** (1.0 / copies)
    is_opacity = torch.arange(len(bias), device=bias.device) % PARAMETERS == PARAMETERS - 1
    return bias + is_opacity * math.log(each / (1.0 - each))
