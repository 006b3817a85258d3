"""GlobalSplat in plain PyTorch: the system's mathematics, one module per part, checked against golden tensors."""

from . import (
    decoder,
    depth_search,
    encoder,
    growth,
    jitter,
    layers,
    loss,
    model,
    normalize,
    rays,
    resample,
    rotation,
    schedule,
    splat,
    stream,
    tokens,
)

__all__ = [
    "decoder",
    "depth_search",
    "encoder",
    "growth",
    "jitter",
    "layers",
    "loss",
    "model",
    "normalize",
    "rays",
    "resample",
    "rotation",
    "schedule",
    "splat",
    "stream",
    "tokens",
]
