"""Basic layers of the model. `params` maps published names to tensors; `name` is the prefix of a layer's names."""

import math

import torch

LAYER_NORM_EPS = 1e-5


def linear(params, name, x):
    """Returns x W^T + b, with weight [out, in]; the bias is omitted if `params` has none."""
    y = x @ params[f"{name}.weight"].T
    bias = params.get(f"{name}.bias")
    return y if bias is None else y + bias


def layer_norm(params, name, x):
    """Returns (x - mean) / sqrt(var + eps) * weight + bias over the last axis; the variance is the biased one."""
    centered = x - x.mean(-1, keepdim=True)
    variance = (centered * centered).mean(-1, keepdim=True)
    return centered / torch.sqrt(variance + LAYER_NORM_EPS) * params[f"{name}.weight"] + params[f"{name}.bias"]


def gelu(x):
    """Returns the exact GELU, x Phi(x)."""
    return 0.5 * x * (1.0 + torch.erf(x / math.sqrt(2.0)))


def mlp(params, first, second, x):
    """Returns W2 GELU(W1 x + b1) + b2."""
    return linear(params, second, gelu(linear(params, first, x)))


def attention(q, k, v, heads):
    """Computes multi-head attention of q [B, Lq, d] to k and v [B, Lk, d]. Returns [B, Lq, d].

    Each head computes softmax(q k^T / sqrt(d / heads)) v.
    """

    def split(x):  # [B, L, d] -> [B, heads, L, d / heads]
        return x.reshape(x.shape[0], x.shape[1], heads, -1).transpose(1, 2)

    q, k, v = split(q), split(k), split(v)
    scores = q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1])
    mixed = torch.softmax(scores, dim=-1) @ v
    return mixed.transpose(1, 2).flatten(2)


def layer_scale(params, name, x):
    return params[f"{name}.gamma"] * x
