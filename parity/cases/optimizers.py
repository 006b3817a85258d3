"""Cases of the optimizers."""

import torch

from ..harness.draw import normal
from ..harness.registry import Draw, case
from ..reference.muon import muon_step


def step_adamw(config, params, inputs):
    """Returns the parameters after the steps of PyTorch's AdamW. Only matrices decay, and no learnable tokens."""
    after = {name: value.detach().clone().requires_grad_() for name, value in params.items()}
    decays = {name: config["weight_decay"] if name.endswith(".weight") else 0.0 for name in params}
    groups = [{"params": [value], "weight_decay": decays[name]} for name, value in after.items()]
    optimizer = torch.optim.AdamW(groups, lr=config["learning_rate"])
    for gradients in zip(*(inputs[f"grad.{name}"] for name in after), strict=True):
        for value, gradient in zip(after.values(), gradients, strict=True):
            value.grad = gradient.clone()
        optimizer.step()
    return after


def step_muon(config, params, inputs):
    """Returns the parameters after steps of Muon, for the matrices of the encoder, or of AdamW."""
    matrices = [name for name in params if name.startswith("slot_encoder.") and name.endswith(".weight")]
    after = step_adamw(config, {name: value for name, value in params.items() if name not in matrices}, inputs)
    for name in matrices:
        value, mean = params[name], torch.zeros_like(params[name])
        for gradient in inputs[f"grad.{name}"]:
            parts = 3 if "qkv" in name else 1
            value, mean = muon_step(value, gradient, mean, config["learning_rate"], config["weight_decay"], parts)
        after[name] = value
    return after


def steps_of(rng, counts, shapes, learning_rate):
    """Yields draws of parameters of these shapes and their gradients in each of `counts` steps."""
    for count in counts:
        params = {name: normal(rng, *shape) for name, shape in shapes.items()}
        gradients = {f"grad.{name}": normal(rng, count, *shape) for name, shape in shapes.items()}
        config = {"learning_rate": learning_rate, "weight_decay": 0.3}
        yield Draw(gradients, config, params, label=f"{count} steps", has_gradients=False)


@case(step_adamw)
def adamw(rng):
    """One step, and several, so that both moments and their bias corrections matter, with and without weight decay."""
    yield from steps_of(rng, (1, 12), {"layer.weight": (4, 7), "layer.bias": (4,), "token": (1, 3, 5)}, 1e-2)


@case(step_muon)
def muon(rng):
    """Wide and tall matrices of the encoder, a fused QKV matrix, and parameters that AdamW updates."""
    shapes = {
        "slot_encoder.flat.weight": (5, 9),
        "slot_encoder.upright.weight": (40, 12),
        "slot_encoder.attn.qkv.weight": (24, 8),
        "slot_encoder.flat.bias": (5,),
        "slot_encoder.token": (1, 3, 5),
        "decoder.weight": (4, 7),
    }
    yield from steps_of(rng, (1, 6), shapes, 0.5)
