"""Cases of values that depend on the training step: subsets of the views, schedules, optimizers."""

from itertools import product

import numpy as np
import torch

from ... import reference
from ..draw import normal
from ..registry import Draw, case, reference_for
from ..tolerance import FLOAT64


@case
def subsets(rng):
    """Odd and even numbers of views, from two on, at odd and even steps."""
    for views, step in product((2, 3, 7, 24), (0, 1)):
        yield Draw(f"{views} views, step {step}", config={"views": views, "step": step})


@reference_for("subsets")
def subsets_reference(config, params, inputs):
    a, b = reference.loss.subsets.subsets(list(range(config["views"])), config["step"])
    return {"a": torch.tensor(a), "b": torch.tensor(b)}


@case
def learning_rate(rng):
    """Steps on both sides of every change of the schedule, beyond its end, and random ones between."""
    for total, warmup, peak in [(220_000, 0.03, 5e-4), (1_000, 0.1, 2e-5), (500, 0.0, 1e-2)]:
        edges = [0, 1, int(warmup * total), int(warmup * total) + 1, total - 1, total, total + 10]
        steps = np.concatenate([edges, rng.integers(0, total, 50)]).astype(np.int64)
        config = {"peak": peak, "total": total, "warmup": warmup}
        yield Draw(f"{total} steps", {"steps": steps}, config, tolerance=FLOAT64)


@reference_for("learning_rate")
def learning_rate_reference(config, params, inputs):
    rates = [
        reference.schedule.learning_rate(step, config["total"], config["peak"], config["warmup"])
        for step in inputs["steps"].tolist()
    ]
    return {"learning_rate": torch.tensor(rates, dtype=torch.float64)}


@case
def stages(rng):
    """Steps on both sides of every boundary, and random ones in and between transitions."""
    for final, full in [(0, False), (1, False), (3, False), (3, True)]:
        edges = [0, 9_999, 10_000, 10_001, 11_999, 12_000, 19_999, 20_000, 49_999, 50_000, 52_000, 220_000]
        steps = np.concatenate([edges, rng.integers(0, 60_000, 50)]).astype(np.int64)
        config = {
            "final_stage": final,
            "boundaries": [10_000, 20_000, 50_000],
            "transition": 2_000,
            "full_capacity": full,
        }
        label = f"final stage {final}, full capacity" if full else f"final stage {final}"
        yield Draw(label, {"steps": steps}, config, tolerance=FLOAT64)


@reference_for("stages")
def stages_reference(config, params, inputs):
    def at(step):
        if config["full_capacity"]:
            return config["final_stage"], 1.0
        return reference.schedule.stage(step, config["final_stage"], config["boundaries"], config["transition"])

    index, mix = zip(*(at(step) for step in inputs["steps"].tolist()), strict=True)
    return {"index": torch.tensor(index), "mix": torch.tensor(mix, dtype=torch.float64)}


@case
def adamw(rng):
    """One step, and several, so that both moments and their bias corrections matter, with and without weight decay."""
    for steps in (1, 12):
        params = {
            "layer.weight": normal(rng, 4, 7),
            "layer.bias": normal(rng, 4),
            "token": normal(rng, 1, 3, 5),
        }
        gradients = {f"grad.{name}": normal(rng, steps, *value.shape) for name, value in params.items()}
        config = {"learning_rate": 1e-2, "weight_decay": 0.3}
        yield Draw(f"{steps} steps", gradients, config, params, gradients=False)


@reference_for("adamw")
def adamw_reference(config, params, inputs):
    # "token" stands for a learnable token of the model, which is recognized by its name.
    published = {"token": "scene_tokens", "slot_encoder.token": "slot_encoder.slot_regs"}
    after = {}
    for name, value in params.items():
        decays = reference.schedule.is_decayed(published.get(name, name), value)
        decay = config["weight_decay"] if decays else 0.0
        first = second = torch.zeros_like(value)
        for count, gradient in enumerate(inputs[f"grad.{name}"], start=1):
            value, first, second = reference.schedule.adamw_step(
                value, gradient, first, second, count, config["learning_rate"], decay
            )
        after[name] = value
    return after


@case
def muon(rng):
    """Wide and tall matrices of the encoder, a fused QKV matrix, and parameters that AdamW updates."""
    for steps in (1, 6):
        params = {
            "slot_encoder.flat.weight": normal(rng, 5, 9),
            "slot_encoder.upright.weight": normal(rng, 40, 12),
            "slot_encoder.attn.qkv.weight": normal(rng, 24, 8),
            "slot_encoder.flat.bias": normal(rng, 5),
            "slot_encoder.token": normal(rng, 1, 3, 5),
            "decoder.weight": normal(rng, 4, 7),
        }
        gradients = {f"grad.{name}": normal(rng, steps, *value.shape) for name, value in params.items()}
        config = {"learning_rate": 0.5, "weight_decay": 0.3}
        yield Draw(f"{steps} steps", gradients, config, params, gradients=False)


@reference_for("muon")
def muon_reference(config, params, inputs):
    rate, decay = config["learning_rate"], config["weight_decay"]
    adamw = [name for name in params if not (name.startswith("slot_encoder.") and name.endswith(".weight"))]
    after = adamw_reference(
        config, {name: params[name] for name in adamw}, {f"grad.{name}": inputs[f"grad.{name}"] for name in adamw}
    )
    for name in params.keys() - after.keys():
        value, mean = params[name], torch.zeros_like(params[name])
        for gradient in inputs[f"grad.{name}"]:
            parts = 3 if "qkv" in name else 1
            value, mean = reference.schedule.muon_step(value, gradient, mean, rate, decay, parts)
        after[name] = value
    return after
