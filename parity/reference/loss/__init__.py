"""The terms of the training objective, one module each."""

from . import (
    consistency,
    decoder_regularization,
    depth_smoothness,
    frustum,
    lpips,
    mask,
    mse,
    ssim,
    subsets,
    vgg19,
)

__all__ = [
    "consistency",
    "decoder_regularization",
    "depth_smoothness",
    "frustum",
    "lpips",
    "mask",
    "mse",
    "ssim",
    "subsets",
    "vgg19",
]
