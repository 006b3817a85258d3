"""Cases of single layers, whose kernels have sizes of their own to respect."""

import numpy as np

from ..harness.compare import Tolerance
from ..harness.draw import normal
from ..harness.registry import Draw, case
from ..reference import layers, rotation


def linear_layer(inputs):
    return layers.linear({f"layer.{name}": value for name, value in inputs.items()}, "layer", inputs["xs"])


@case(linear_layer, "out")
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
        yield Draw(numbers, differentiate=tuple(numbers))


def in_bf16(drawn):
    """Truncates float32 inputs to bfloat16, in which the program computes: clears the lower 16 bits."""
    for numbers in drawn.inputs.values():
        numbers.view(np.uint32)[...] &= 0xFFFF0000
    drawn.config |= {"bf16": True}
    return drawn


LINEAR_BF16 = Tolerance(
    4e-3,
    8e-3,
    why="outputs, gradients and the terms of their sums are bfloat16 (8 significant bits); each rounding changes a value by up to 1/256",
)


@case(linear_layer, "out", module="linear", tolerance=LINEAR_BF16)
def linear_bf16(rng):
    """Linear layers in bfloat16. The reference gets the same bfloat16 values and computes with its usual precision."""
    yield from map(in_bf16, linear(rng))


def attend(inputs, heads, thirds=False):
    q, k, v = inputs["rows"].chunk(3, dim=-1) if thirds else (inputs[name] for name in "qkv")
    return layers.attention(q, k, v, heads)


def attention_draw(rng, batch, queries, keys, heads, width, scale=1.0):
    """Returns a draw of q, k, v, for which the attention scores have a standard deviation of about `scale`.

    Inputs are normal, and the deviation of a dot product is the square root of its length.
    """
    q, k, v = (normal(rng, batch, count, heads * width) for count in (queries, keys, keys))
    return Draw({"q": np.float32(scale) * q, "k": k, "v": v}, {"heads": heads}, differentiate=("q", "k", "v"))


@case(attend, "out")
def attention(rng):
    """Attention of sizes around the kernel's block sizes, from one query and one key on.

    The kernel processes six queries at a time, keys by vectors, panels or blocks of 256 or 384, and widths by vectors,
    and distributes many of either to threads. Widths of 4 and more are supported by the kernel or not. In the last
    case, queries, keys and values are thirds of the same rows, as in self-attention.
    """
    for sizes in [
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
        yield attention_draw(rng, *sizes)
    equal = attention_draw(rng, 1, 30, 90, 2, 32)
    equal.inputs["k"][:] = equal.inputs["k"][:, :1]
    yield equal
    yield Draw({"rows": normal(rng, 2, 70, 3 * 96)}, {"heads": 3, "thirds": True}, differentiate=("rows",))


ATTENTION_LARGE = Tolerance(
    1e-4,
    1e-3,
    why="float32 rounds a score of 80 by up to 4e-6, which becomes a relative error of 4e-6 in its exponential",
)


@case(attend, "out", module="attention", tolerance=ATTENTION_LARGE)
def attention_large(rng):
    """Extreme scores: about ±80, whose exponentials overflow float32; all below zero, where they would underflow; and
    one key that gets nearly all attention of half of the queries."""
    yield attention_draw(rng, 1, 60, 300, 2, 32, scale=25.0)
    below = attention_draw(rng, 2, 20, 70, 2, 16)
    below.inputs["q"] = np.abs(below.inputs["q"]) + 4.0
    below.inputs["k"] -= 5.0
    yield below
    one = attention_draw(rng, 1, 40, 600, 1, 64)
    q, k = one.inputs["q"], one.inputs["k"]
    k[:, 333] = 3.0 * np.sign(q[:, :1].mean(0))
    q[:, ::2] += k[:, 333:334]
    yield one


ATTENTION_BF16 = Tolerance(
    4e-3, 5e-3, why="outputs, attention weights and gradients of scores are bfloat16 (8 significant bits)"
)


@case(attend, "out", module="attention", tolerance=ATTENTION_BF16)
def attention_bf16(rng):
    """Attention in bfloat16. The reference gets the same bfloat16 values and computes with its usual precision.

    The kernel processes 512 keys and 32 queries at a time, and columns in panels of 64; in the backward pass, 128 of
    both.
    """
    for sizes in [
        (1, 1, 1, 1, 8),
        (2, 33, 65, 3, 16),
        (1, 70, 513, 2, 64),
        (1, 13, 1100, 1, 128),
        (2, 40, 130, 2, 40),
    ]:
        yield in_bf16(attention_draw(rng, *sizes))


def quaternion_from_6d(rotations):
    return rotation.quaternion_from_matrix(rotation.matrix_from_6d(rotations))


@case(quaternion_from_6d, "quaternion")
def quaternion(rng):
    """Random 6D rotations, the identity, and rotations by 180°, whose quaternion has no real part."""
    turns = np.float32([[1, 0, 0, 0, 1, 0], [1, 0, 0, 0, -1, 0], [-1, 0, 0, 0, 1, 0], [-1, 0, 0, 0, -1, 0]])
    for six in [
        normal(rng, 3, 17, 6),
        normal(rng, 50, 6),
        normal(rng, 2, 2, 5, 6, scale=0.1) + turns[0],
        turns * np.float32([[0.5], [1], [2], [3]]),
    ]:
        yield Draw({"rotations": six}, differentiate=("rotations",))
