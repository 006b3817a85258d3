"""Conversion of the weights of a smaller model to those of a larger one."""

import math

import torch

SPREAD = 0.2
PARAMETERS = 10  # outputs per candidate, the last of which is the opacity logit


def shrink_patch_weights(weights, patch, patch_size_ratio):
    """Converts patch embedding weights [d, p p C] to patches of edge p / r: [d, p p C / r²], r = `patch_size_ratio`.

    The weight of a pixel is the sum over the pixels of the large patch that it is upscaled to.
    """
    edge = patch // patch_size_ratio
    pixels = weights.reshape(len(weights), patch, patch, -1)
    summed = pixels.new_zeros(len(weights), edge, edge, pixels.shape[-1])
    for row in range(patch_size_ratio):
        for column in range(patch_size_ratio):
            summed = summed + pixels[:, row::patch_size_ratio, column::patch_size_ratio]
    return summed.flatten(1)


def repeat_scene_tokens(tokens, noise):
    """Repeats each token of [M, d] n times in place and adds scaled normal noise [n M, d]. Returns [n M, d]."""
    owners = torch.arange(len(noise), device=tokens.device) // (len(noise) // len(tokens))
    deviation = ((tokens - tokens.mean()) ** 2).mean().sqrt()
    return tokens[owners] + SPREAD * deviation * noise


def split_opacity_bias(bias, latent_ratio):
    """Adds logit(1 - 2^(-1/n)) to the opacity biases, with n = `latent_ratio`.

    An opacity of one half becomes 1 - 2^(-1/n); n overlapping Gaussians of this opacity have a total of one half.
    """
    each = 1.0 - 0.5 ** (1.0 / latent_ratio)
    is_opacity = torch.arange(len(bias), device=bias.device) % PARAMETERS == PARAMETERS - 1
    return bias + is_opacity * math.log(each / (1.0 - each))
