"""Basic layers of the model. `params` maps published names to tensors; `name` is the prefix of a layer's names."""

from torch.nn import functional

LAYER_NORM_EPS = 1e-5


def linear(params, name, x):
    """Returns x W^T + b, with weight [out, in]; the bias is omitted if `params` has none."""
    return functional.linear(x, params[f"{name}.weight"], params.get(f"{name}.bias"))


def layer_norm(params, name, x):
    """Returns (x - mean) / sqrt(var + eps) * weight + bias over the last axis; the variance is the biased one."""
    weight = params[f"{name}.weight"]
    return functional.layer_norm(x, weight.shape, weight, params[f"{name}.bias"], LAYER_NORM_EPS)


def mlp(params, first, second, x):
    """Returns W2 GELU(W1 x + b1) + b2, with the exact GELU."""
    return linear(params, second, functional.gelu(linear(params, first, x)))


def attention(q, k, v, heads):
    """Computes multi-head attention of q [B, Lq, d] to k and v [B, Lk, d]. Returns [B, Lq, d].

    Each head computes softmax(q k^T / sqrt(d / heads)) v.
    """
    q, k, v = (x.unflatten(-1, (heads, -1)).transpose(1, 2) for x in (q, k, v))
    return functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)


def layer_scale(params, name, x):
    return params[f"{name}.gamma"] * x
