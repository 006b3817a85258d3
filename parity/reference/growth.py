"""Weights of a smaller model as those of a larger one."""

import math

import torch

SPREAD = 0.2
PARAMETERS = 10  # of a candidate, the last one its opacity logit


def for_smaller_patches(weights, patch, times):
    """[d, p p C] -> [d, p p C / times²]: what a pixel of a small patch is weighed by is the sum over those it is enlarged to."""
    edge = patch // times
    pixels = weights.reshape(len(weights), patch, patch, -1)
    summed = pixels.new_zeros(len(weights), edge, edge, pixels.shape[-1])
    for row in range(times):
        for column in range(times):
            summed = summed + pixels[:, row::times, column::times]
    return summed.flatten(1)


def more_tokens(tokens, noise):
    """[M, d] and normal numbers [n M, d] -> [n M, d]: every token n times in its place, a little apart."""
    owners = torch.arange(len(noise), device=tokens.device) // (len(noise) // len(tokens))
    deviation = ((tokens - tokens.mean()) ** 2).mean().sqrt()
    return tokens[owners] + SPREAD * deviation * noise


def shared_opacities(bias, copies):
    """The logit of an opacity of one half becomes that of 1 - 2^(-1/n), of which n on one another cover one half."""
    each = 1.0 - 0.5 ** (1.0 / copies)
    is_opacity = torch.arange(len(bias), device=bias.device) % PARAMETERS == PARAMETERS - 1
    return bias + is_opacity * math.log(each / (1.0 - each))
