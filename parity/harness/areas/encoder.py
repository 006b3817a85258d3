"""Cases of the encoder, from the tokens of all views to the scene's latents."""

from dataclasses import replace

import numpy as np
import torch

from ... import reference
from ...reference.names import reference_config, with_prefix
from .. import draw
from ..draw import integer, normal
from ..registry import Draw, by, case, reference_for
from ..tolerance import Tolerance

REGISTERS = 4  # number of registers, which are the last slots of a stream


@case
def linear(rng):
    """Linear layers with and without bias, for one row, and for batches of rows.

    The program sums weight gradients over 2048 rows at a time, so there are cases with 2049 and with 4096 rows.
    """
    for rows, inputs, outputs, biased in [
        ((1,), 3, 1, True),
        ((2, 7), 5, 9, False),
        ((3, 17), 64, 33, True),
        ((2049,), 24, 20, True),
        ((2, 2048), 16, 8, False),
    ]:
        numbers = {"xs": normal(rng, *rows, inputs), "weight": normal(rng, outputs, inputs, scale=inputs**-0.5)}
        if biased:
            numbers["bias"] = normal(rng, outputs)
        label = f"{by(*rows, inputs)} to {outputs}, {'with' if biased else 'without'} bias"
        yield Draw(label, numbers, differentiate=tuple(numbers))


@case
def linear_bf16(rng):
    """Linear layers in bfloat16. The reference gets the same bfloat16 values and computes with its usual precision."""
    why = "outputs, gradients and the terms of their sums are bfloat16 (8 significant bits); each rounding changes a value by up to 1/256"
    tolerance = Tolerance(4e-3, 8e-3, why=why)
    for drawn in linear(rng):
        cut_to_bf16(drawn.inputs)
        yield replace(drawn, config={"bf16": True}, module="linear", tolerance=tolerance)


def cut_to_bf16(inputs):
    """Truncates float32 values to bfloat16 in place: clears the lower 16 bits."""
    for numbers in inputs.values():
        numbers.view(np.uint32)[...] &= 0xFFFF0000


@reference_for("linear")
def linear_reference(config, params, inputs):
    layer = {f"layer.{name}": value for name, value in inputs.items()}
    return {"out": reference.layers.linear(layer, "layer", inputs["xs"])}


def attention_inputs(rng, batch, queries, keys, width, scale=1.0):
    """Returns random q, k, v, for which the attention scores have a standard deviation of about `scale`.

    Inputs are normal, and the deviation of a dot product is the square root of its length.
    """
    shapes = {"q": (batch, queries, width), "k": (batch, keys, width), "v": (batch, keys, width)}
    inputs = {name: normal(rng, *shape) for name, shape in shapes.items()}
    inputs["q"] *= np.float32(scale)
    return inputs


def attention_draw(inputs, heads, what="", **more):
    q, k = inputs["q"], inputs["k"]
    label = f"{by(*q.shape)} to {by(*k.shape)}, heads {heads}{what}"
    return Draw(label, inputs, {"heads": heads}, differentiate=tuple(inputs), module="attention", **more)


@case
def attention(rng):
    """Attention of sizes around the kernel's block sizes, from one query and one key on.

    The kernel processes six queries at a time, keys by vectors, panels or blocks of 256 or 384, and widths by vectors,
    and distributes many of either to threads. Widths of 4 and more are supported by the kernel or not. In the last
    case, queries, keys and values are thirds of the same rows, as in self-attention.
    """
    for batch, queries, keys, heads, width in [
        (1, 1, 1, 1, 8),
        (3, 1, 17, 2, 4),
        (2, 7, 65, 3, 8),
        (1, 37, 1, 2, 16),
        (1, 13, 257, 1, 128),
        (2, 50, 385, 4, 32),
        (1, 103, 1000, 2, 64),
        (1, 1100, 70, 1, 24),
        (1, 9, 40, 2, 5),
        (1, 9, 40, 1, 136),
    ]:
        yield attention_draw(attention_inputs(rng, batch, queries, keys, heads * width), heads)
    inputs = attention_inputs(rng, 1, 30, 90, 64)
    inputs["k"][:] = inputs["k"][:, :1]
    yield attention_draw(inputs, 2, ", all keys equal")
    rows = normal(rng, 2, 70, 3 * 96)
    config = {"heads": 3, "thirds": True}
    yield Draw("2×70×288 in thirds, heads 3", {"rows": rows}, config, differentiate=("rows",))


@case
def attention_large(rng):
    """Extreme scores: about ±80, whose exponentials overflow float32; all below zero, where they would underflow; and
    one key that gets nearly all attention of half of the queries."""
    why = "float32 rounds a score of 80 by up to 4e-6, which becomes a relative error of 4e-6 in its exponential"
    tolerance = Tolerance(1e-4, 1e-3, why=why)
    yield attention_draw(attention_inputs(rng, 1, 60, 300, 64, scale=25.0), 2, tolerance=tolerance)
    inputs = attention_inputs(rng, 2, 20, 70, 32)
    inputs["q"] = np.abs(inputs["q"]) + 4.0
    inputs["k"] -= 5.0
    yield attention_draw(inputs, 2, ", all below zero", tolerance=tolerance)
    inputs = attention_inputs(rng, 1, 40, 600, 64)
    inputs["k"][:, 333] = 3.0 * np.sign(inputs["q"][:, :1].mean(0))
    inputs["q"][:, ::2] += inputs["k"][:, 333:334]
    yield attention_draw(inputs, 1, ", one dominating", tolerance=tolerance)


@case
def attention_bf16(rng):
    """Attention in bfloat16. The reference gets the same bfloat16 values and computes with its usual precision.

    The kernel processes 512 keys and 32 queries at a time, and columns in panels of 64; in the backward pass, 128 of
    both.
    """
    why = "outputs, attention weights and gradients of scores are bfloat16 (8 significant bits)"
    tolerance = Tolerance(4e-3, 5e-3, why=why)
    for batch, queries, keys, heads, width in [
        (1, 1, 1, 1, 8),
        (2, 33, 65, 3, 16),
        (1, 70, 513, 2, 64),
        (1, 13, 1100, 1, 128),
        (2, 40, 130, 2, 40),
    ]:
        inputs = attention_inputs(rng, batch, queries, keys, heads * width)
        cut_to_bf16(inputs)
        yield replace(attention_draw(inputs, heads, tolerance=tolerance), config={"heads": heads, "bf16": True})


@reference_for("attention")
def attention_reference(config, params, inputs):
    q, k, v = inputs["rows"].chunk(3, dim=-1) if config.get("thirds") else (inputs[name] for name in "qkv")
    return {"seen": reference.layers.attention(q, k, v, config["heads"])}


@case
def stream_round(rng):
    """One round of one stream: cross-attention of the slots to the memory, then self-attention."""
    for _ in range(3):
        config = draw.model_config(rng)
        batch, slots, memory = integer(rng, 1, 3), integer(rng, 6, 15), integer(rng, 5, 30)
        inputs = {
            "slots": normal(rng, batch, slots, config["width"]),
            "memory": normal(rng, batch, memory, config["ray_width"] + config["rgb_width"]),
        }
        params = draw.parameters(rng, config, "slot_encoder.geo_rounds.0.")
        label = f"{by(*inputs['slots'].shape)}, memory {by(*inputs['memory'].shape)}, heads {config['heads']}"
        yield Draw(label, inputs, config, params, ("slots", "memory"))


@reference_for("stream_round")
def stream_round_reference(config, params, inputs):
    slots, memory = inputs["slots"], inputs["memory"]
    mask = torch.ones(slots.shape[1], 1, dtype=slots.dtype)
    mask[-REGISTERS:] = 0.0
    heads, blocks = config["heads"], config["self_attention_blocks"]
    return {
        "slots": reference.stream.stream_round(
            with_prefix("round", params), "round", slots, memory, heads, blocks, mask
        )
    }


@case
def self_attention_block(rng):
    """Self-attention blocks of at least one slot, which attends only to itself."""
    for _ in range(3):
        config = draw.model_config(rng)
        slots = normal(rng, integer(rng, 1, 3), integer(rng, 1, 15), config["width"])
        params = draw.parameters(rng, config, "slot_encoder.geo_rounds.0.tower.0.")
        yield Draw(f"{by(*slots.shape)}, heads {config['heads']}", {"slots": slots}, config, params, ("slots",))


@reference_for("self_attention_block")
def self_attention_block_reference(config, params, inputs):
    params = with_prefix("block", params)
    return {"slots": reference.stream.self_attention_block(params, "block", inputs["slots"], config["heads"])}


@case
def mixer(rng):
    """The exchange between the two streams after a round."""
    for _ in range(3):
        config = draw.model_config(rng)
        shape = integer(rng, 1, 3), integer(rng, 1, 15), config["width"]
        inputs = {"geometry": normal(rng, *shape), "appearance": normal(rng, *shape)}
        params = draw.parameters(rng, config, "slot_encoder.pair_adapters.0.")
        yield Draw(by(*shape), inputs, config, params, ("geometry", "appearance"))


@reference_for("mixer")
def mixer_reference(config, params, inputs):
    params = with_prefix("mixer", params)
    geometry, appearance = reference.encoder.mixer(params, "mixer", inputs["geometry"], inputs["appearance"])
    return {"geometry": geometry, "appearance": appearance}


@case
def encoder(rng):
    """The complete encoder, with two streams and with the ablation's single stream."""
    for streams in ("dual", "dual", "single"):
        config = draw.model_config(rng, streams=streams)
        shape = integer(rng, 1, 3), integer(rng, 4, 40), config["ray_width"] + config["rgb_width"]
        params = draw.parameters(rng, config)
        params = {name: value for name, value in params.items() if name.startswith(("scene_tokens", "slot_encoder"))}
        label = f"{by(*shape)}, slots {by(config['latents'], config['width'])}, rounds {config['rounds']}, {streams}"
        yield Draw(label, {"tokens": normal(rng, *shape)}, config, params, ("tokens",))


@reference_for("encoder")
def encoder_reference(config, params, inputs):
    tokens = inputs["tokens"][:, None]  # as tokens of one view, because the encoder doesn't distinguish views
    geometry, appearance = reference.encoder.encode(reference_config(config), params, tokens)
    return {"geometry": geometry, "appearance": appearance}
