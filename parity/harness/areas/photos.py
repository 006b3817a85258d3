"""Cases of the preprocessing and augmentation of photos."""

import numpy as np
import torch

from ... import reference
from ..draw import uniform
from ..registry import Draw, by, case, reference_for
from ..tolerance import Tolerance

RESAMPLE = Tolerance(
    3e-4,
    0.0,
    why="results are rounded to 8 bits, so a value near a rounding boundary may differ by one level; 3e-4 allows this for one value in 700",
)

MATCHING = Tolerance(
    5e-5,
    0.0,
    why="variances of patches with little texture are small differences of means, and a small margin between planes is one of costs",
)


@case
def resample(rng):
    """Random photos, and saturated ones, in which the filter overshoots the range of values."""
    for shape, region, size in [
        ((45, 80), (0, 0, 80, 45), (32, 57)),
        ((45, 80), (20.3, 1.7, 40.2, 41.9), (31, 29)),
        ((30, 21), (0, 0, 21, 30), (50, 33)),
        ((90, 70), (35.5, 44.5, 30.25, 40), (8, 6)),
    ]:
        for saturated in (False, True):
            image = rng.integers(0, 256, (*shape, 3))
            image = np.where(image < 128, 0, 255) if saturated else image
            label = f"{by(*shape)} to {by(*size)}{', saturated' if saturated else ''}"
            config = {"region": region, "size": size}
            yield Draw(label, {"image": image.astype(np.uint8)}, config, tolerance=RESAMPLE)


@reference_for("resample")
def resample_reference(config, params, inputs):
    height, width = config["size"]
    return {"image": reference.resample.resample(inputs["image"], config["region"], height, width)}


@case
def jitter(rng):
    """Each adjustment alone, and all of them in two orders; some pixels are grey, black or white."""
    one = [{"brightness": 1.3}, {"contrast": 0.6}, {"saturation": 1.4}, {"hue": -0.1}, {"hue": 0.45}]
    several = [{"hue": 0.1}, {"contrast": 1.4}, {"brightness": 0.7}, {"saturation": 0.7}]
    for adjustments in [*([adjustment] for adjustment in one), several, several[::-1]]:
        image = uniform(rng, 0.0, 1.0, 3, 13, 22)
        image[:, 0] = image[:1, 0]
        image[:, 1, :11], image[:, 1, 11:] = 0.0, 1.0
        names = ", ".join(next(iter(adjustment)) for adjustment in adjustments)
        yield Draw(names, {"image": image}, {"adjustments": adjustments})


@reference_for("jitter")
def jitter_reference(config, params, inputs):
    adjustments = [next(iter(adjustment.items())) for adjustment in config["adjustments"]]
    return {"image": reference.jitter.jitter(inputs["image"], adjustments)}


def photos_to_compare(rng, size, other_size, count, planes, weighted):
    """Returns inputs and configuration: random patterns from cameras that look in about the same direction; the fifth faces away."""
    inputs = {"grey": uniform(rng, 0.0, 1.0, *size), "others": uniform(rng, 0.0, 1.0, count, *other_size)}
    shapes = {"weight": size, "other_weights": (count, *other_size)}
    for name in weighted:
        ramp = np.linspace(-0.5, 2.0, shapes[name][-1])
        inputs[name] = np.clip(ramp + uniform(rng, -0.1, 0.1, *shapes[name]), 0.0, 1.0).astype(np.float32)
    focal = float(max(size))
    back = np.array([[1 / focal, 0, -0.5 * size[1] / focal], [0, 1 / focal, -0.5 * size[0] / focal], [0, 0, 1]])
    there = np.array([[focal, 0, 0.5 * other_size[1]], [0, focal, 0.5 * other_size[0]], [0, 0, 1]])
    matrices = []
    for index in range(count):
        rotation = np.eye(3) + 0.05 * rng.standard_normal((3, 3))
        if index == 4:
            rotation[2] *= -1
        translation = 0.3 * rng.standard_normal((3, 1))
        matrices.append(there @ np.hstack((rotation @ back, translation)))
    inputs["to_pixels"] = np.stack(matrices).astype(np.float32)
    return inputs, {"step": 0.7 / (planes - 1), "planes": planes}


def comparison_label(size, other_size, count, planes, weighted):
    return f"{by(*size)}, {count} of {by(*other_size)}, {planes} planes{''.join(f', {name}' for name in weighted)}"


@case
def depth_search(rng):
    """Photos of random patterns from cameras that look in about the same direction, some with weights, and one that faces away.

    The kernel processes a vector of columns and eight planes at a time; the sizes are around multiples of these.
    """
    for shapes in [
        ((9, 9), (9, 9), 1, 2, ()),
        ((20, 33), (27, 41), 2, 9, ()),
        ((24, 32), (24, 32), 4, 16, ()),
        ((19, 47), (24, 31), 5, 11, ("weight",)),
        ((30, 17), (21, 50), 3, 8, ("other_weights",)),
        ((26, 30), (26, 30), 4, 10, ("weight", "other_weights")),
    ]:
        inputs, config = photos_to_compare(rng, *shapes)
        doubles = {name: torch.tensor(value).double() for name, value in inputs.items()}
        doubtful = search(config, doubles)[2].numpy()[None, None]
        yield Draw(comparison_label(*shapes), inputs, config, doubtful=doubtful)


def search(config, inputs):
    return reference.depth_search.search(*compared(inputs), config["step"], config["planes"])


def compared(inputs):
    return [inputs.get(name) for name in ("grey", "weight", "others", "other_weights", "to_pixels")]


@reference_for("depth_search")
def depth_search_reference(config, params, inputs):
    inverse_depth, correlation, _ = search(config, inputs)
    return {"inverse_depth": inverse_depth[None, None], "correlation": correlation[None, None]}


@case
def semi_global_matching(rng):
    """Photos like those of depth_search, half of the first without texture.

    The kernel processes a vector of planes at a time; their numbers are around multiples of it.
    """
    for shapes in [
        ((9, 9), (9, 9), 1, 2, ()),
        ((12, 25), (14, 21), 2, 9, ()),
        ((16, 18), (16, 18), 4, 33, ()),
        ((19, 15), (12, 17), 5, 16, ("weight",)),
        ((15, 22), (15, 22), 4, 17, ("weight", "other_weights")),
    ]:
        # Rounding must not decide whether a pixel counts.
        for _ in range(100):
            inputs, config = photos_to_compare(rng, *shapes)
            inputs["grey"][:, : shapes[0][1] // 2] *= 0.02
            doubles = {name: torch.tensor(value).double() for name, value in inputs.items()}
            doubtful = match(config, doubles)[2].numpy()[None, None]
            if not doubtful.all():
                break
        yield Draw(comparison_label(*shapes), inputs, config, tolerance=MATCHING, doubtful=doubtful)


def match(config, inputs):
    limit = 2e-5
    return reference.depth_search.match_semi_globally(*compared(inputs), config["step"], config["planes"], limit)


@reference_for("semi_global_matching")
def semi_global_matching_reference(config, params, inputs):
    inverse_depth, sureness, _ = match(config, inputs)
    return {"inverse_depth": inverse_depth[None, None], "sureness": sureness[None, None]}
