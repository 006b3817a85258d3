"""Regularizers of the outputs of the decoder's heads, per candidate, before clamps and merging."""

import math

import torch

LARGEST_SCALE = 0.05
SH_CAP = 5.0
LARGEST_OPACITY = 0.2
WEIGHT = 1e-2


def scale_term(log_scale):
    """Returns mean relu(log s - log 0.05)^2 of log-scales before their clamp."""
    return (torch.relu(log_scale - math.log(LARGEST_SCALE)) ** 2).mean()


def rotation_term(rotation):
    """Returns mean r^2 of the raw 6D residuals."""
    return (rotation**2).mean()


def sh_soft_cap(sh):
    """Returns mean softplus(|c| - 5)^2 of the raw coefficients."""
    return (torch.nn.functional.softplus(sh.abs() - SH_CAP) ** 2).mean()


def opacity_term(logit):
    """Returns mean alpha + mean relu(o - logit(0.2))^2."""
    threshold = math.log(LARGEST_OPACITY / (1.0 - LARGEST_OPACITY))
    return torch.sigmoid(logit).mean() + (torch.relu(logit - threshold) ** 2).mean()


def decoder_regularization(raw, with_opacity=True):
    """Returns 1e-2 (L_opacity + L_scale + L_rot + L_SH) of the "raw" dict of decoder.decode; L_opacity is optional."""
    total = scale_term(raw["log_scale"]) + rotation_term(raw["rotation"]) + sh_soft_cap(raw["sh"])
    if with_opacity:
        total = total + opacity_term(raw["opacity_logit"])
    return WEIGHT * total
