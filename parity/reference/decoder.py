"""The decoder: latent tokens to Gaussians. K candidates per token are merged to G = 2^stage Gaussians."""

import math

import torch

from .layers import linear
from .rotation import matrix_from_6d, normalize, quaternion_from_matrix

LOG_SCALE_OFFSET = -2.0
LOG_SCALE_RANGE = (math.log(1e-4) - 1.0, math.log(0.05) + 2.0)
OPACITY_OFFSET = -5.0
OPACITY_LOGIT_RANGE = (-13.0, 6.0)
LARGEST_OPACITY = 0.99
LARGEST_LOG_U = -1e-12
ROTATION_OFFSET = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
MEAN_OFFSET = (0.0, 0.0, 1.5)


def candidates(config, params, geometry, appearance, mix):
    """Applies the heads to geometry and appearance [B, M, d]. Returns values [B, M, K, ...] after offsets and clamps.

    mix is the transition coefficient lambda: below 1 it lowers the opacity logit, by ln 2 at lambda = 0.
    """
    shape = (*geometry.shape[:2], config["candidates"])
    coefficients = (config["sh_degree"] + 1) ** 2
    parameters = linear(params, "gaussian_decoder.geo_param_readout", geometry).reshape(*shape, 10)
    opacity = parameters[..., 9:10] + OPACITY_OFFSET - (1.0 - mix) * math.log(2.0)
    return {
        "position": linear(params, "gaussian_decoder.geo_pos_readout", geometry).reshape(*shape, 3),
        "log_scale": (parameters[..., 0:3] + LOG_SCALE_OFFSET).clamp(*LOG_SCALE_RANGE),
        "rotation": parameters[..., 3:9],
        "opacity": opacity.clamp(*OPACITY_LOGIT_RANGE),
        "sh": linear(params, "gaussian_decoder.sh_readout", appearance).reshape(*shape, coefficients, 3),
    }


def log_transparency(logit):
    """Returns log u = log(1 - sigmoid(o)) = log sigmoid(-o), clamped to <= -1e-12 so that its inverse stays finite."""
    return torch.nn.functional.logsigmoid(-logit).clamp(max=LARGEST_LOG_U)


def logit_of_transparency(log_u):
    """Returns the logit of 1 - u: log(1 - e^(log u)) - log u.

    log(1 - e^x) is computed as log(-expm1(x)) near zero and as log1p(-e^x) elsewhere. Near zero the latter would be
    log 0, so its argument is replaced: the gradient of the branch that is not selected must be finite, too.
    """
    near = log_u > -math.log(2.0)
    log_alpha_near = torch.log(-torch.expm1(log_u))
    log_alpha_far = torch.log1p(-torch.exp(torch.where(near, -1.0, log_u)))
    return torch.where(near, log_alpha_near, log_alpha_far) - log_u


def merge(full, gate, stage):
    """Merges candidates [B, M, K, ...] to [B, M, G, ...] with G = 2^stage, in groups of b = K / G consecutive
    candidates.

    Values are weighted sums with w = softmax(gate) in the group, except
      log-scales:  sum w log s + ln(b) / 3        (the volume of b Gaussians)
      opacities:   log u = sum w log u_i,  u = 1 - alpha
    """
    exposed = 2**stage
    b = gate.shape[-1] // exposed
    weights = torch.softmax(gate.unflatten(-1, (exposed, b)), dim=-1)  # [B, M, G, b]

    def weighted_sum(x):  # [B, M, K, ...] -> [B, M, G, ...]
        x = x.unflatten(2, (exposed, b))
        return (weights.reshape(weights.shape + (1,) * (x.dim() - 4)) * x).sum(3)

    log_u = weighted_sum(log_transparency(full["opacity"])).clamp(max=LARGEST_LOG_U)
    return {
        "position": weighted_sum(full["position"]),
        "log_scale": weighted_sum(full["log_scale"]) + math.log(b) / 3.0,
        "rotation": weighted_sum(full["rotation"]),
        "opacity": logit_of_transparency(log_u),
        "sh": weighted_sum(full["sh"]),
    }


def expand(parent):
    """Expands [B, M, G, ...] to [B, M, 2 G, ...]: two children per parent, with half its volume and half its log u."""
    child = {key: value.repeat_interleave(2, dim=2) for key, value in parent.items()}
    child["log_scale"] = child["log_scale"] - math.log(2.0) / 3.0
    child["opacity"] = logit_of_transparency(0.5 * log_transparency(child["opacity"]))
    return child


def merge_with_transition(full, gate, stage, mix):
    """Returns (1 - lambda) expand(merge at stage - 1) + lambda (merge at stage), in the space of the merged values."""
    merged = merge(full, gate, stage)
    if stage == 0:
        return merged
    coarse = expand(merge(full, gate, stage - 1))
    return {key: (1.0 - mix) * coarse[key] + mix * merged[key] for key in merged}


def decode(config, params, geometry, appearance, stage, mix):
    """Decodes geometry and appearance [B, M, d] to a dict of N = M G Gaussians, token-major.

    The dict has means [B, N, 3], scales [B, N, 3], rotations_6d [B, N, 6], quaternions (w, x, y, z) [B, N, 4],
    opacities [B, N] and sh [B, N, C, 3].
    """
    full = candidates(config, params, geometry, appearance, mix)
    gate = linear(params, "gaussian_decoder.gate_readout", geometry)
    merged = merge_with_transition(full, gate, stage, mix)
    flat = {key: value.flatten(1, 2) for key, value in merged.items()}

    def constant(values):
        return torch.tensor(values, dtype=geometry.dtype, device=geometry.device)

    six = flat["rotation"] + constant(ROTATION_OFFSET)
    six = torch.cat([normalize(six[..., :3], 1e-8), normalize(six[..., 3:], 1e-8)], dim=-1)
    return {
        "means": flat["position"] + params.get("gaussian_decoder.patch_center_bias", constant(MEAN_OFFSET)),
        "scales": torch.exp(flat["log_scale"]),
        "rotations_6d": six,
        "quaternions": quaternion_from_matrix(matrix_from_6d(six)),
        "opacities": torch.sigmoid(flat["opacity"]).clamp(0.0, LARGEST_OPACITY).squeeze(-1),
        "sh": flat["sh"],
    }
