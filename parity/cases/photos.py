"""Cases of photos: preprocessing, augmentation, and the search for depths."""

import colorsys
from functools import wraps

import numpy as np
import torch
from PIL import Image

from ..harness.compare import Tolerance
from ..harness.draw import uniform
from ..harness.registry import Draw, by, case
from ..reference import depth_search as search

RESAMPLE = Tolerance(
    3e-4,
    0.0,
    why="results are rounded to 8 bits, so a value near a rounding boundary may differ by one level; 3e-4 allows this for one value in 700",
)


def pillow_resample(image, region, size):
    """Resizes a region (left, top, width, height) of an image [H, W, 3] to [3, *size]."""
    left, top, width, height = region
    resized = Image.fromarray(image.numpy()).resize(
        size[::-1], Image.Resampling.LANCZOS, box=(left, top, left + width, top + height)
    )
    return torch.tensor(np.asarray(resized, dtype=np.float32)).movedim(-1, 0)


@case(pillow_resample, "image", tolerance=RESAMPLE)
def resample(rng):
    """Random photos, and saturated ones, in which the filter overshoots the range of values."""
    for shape, region, size in [
        ((45, 80), (0, 0, 80, 45), (32, 57)),
        ((45, 80), (20.3, 1.7, 40.2, 41.9), (31, 29)),
        ((30, 21), (0, 0, 21, 30), (50, 33)),
        ((90, 70), (35.5, 44.5, 30.25, 40), (8, 6)),
    ]:
        image = rng.integers(0, 256, (*shape, 3))
        for numbers in (image, np.where(image < 128, 0, 255)):
            yield Draw({"image": numbers.astype(np.uint8)}, {"region": region, "size": size})


def shift_hue(image, turn):
    """Adds `turn` to the hue of an image [3, H, W], pixel by pixel."""
    turned = torch.empty_like(image)
    for row, column in np.ndindex(*image.shape[1:]):
        hue, saturation, value = colorsys.rgb_to_hsv(*image[:, row, column].tolist())
        color = colorsys.hsv_to_rgb((hue + turn) % 1.0, saturation, value)
        turned[:, row, column] = torch.tensor(color, dtype=image.dtype)
    return turned


def adjust_colors(image, adjustments):
    """Adjusts the colors of an image [3, H, W] in [0, 1] in order, as torchvision's functional transforms do."""
    for adjustment in adjustments:
        [(name, factor)] = adjustment.items()
        if name == "hue":
            image = shift_hue(image, factor)
            continue
        gray = torch.tensordot(torch.tensor([0.2989, 0.587, 0.114], dtype=image.dtype), image, dims=1)
        other = {"brightness": 0.0, "contrast": gray.mean(), "saturation": gray}[name]
        image = (factor * image + (1.0 - factor) * other).clamp(0.0, 1.0)
    return image


@case(adjust_colors, "image")
def jitter(rng):
    """Each adjustment alone, and all of them in two orders; some pixels are gray, black or white."""
    one = [{"brightness": 1.3}, {"contrast": 0.6}, {"saturation": 1.4}, {"hue": -0.1}, {"hue": 0.45}]
    several = [{"hue": 0.1}, {"contrast": 1.4}, {"brightness": 0.7}, {"saturation": 0.7}]
    for adjustments in [*([adjustment] for adjustment in one), several, several[::-1]]:
        image = uniform(rng, 0.0, 1.0, 3, 13, 22)
        image[:, 0] = image[:1, 0]
        image[:, 1, :11], image[:, 1, 11:] = 0.0, 1.0
        yield Draw({"image": image}, {"adjustments": adjustments})


def photos_to_compare(rng, size, other_size, count, planes, *weighted):
    """Returns a draw of random patterns from cameras that look in about the same direction; the fifth faces away."""
    inputs = {"gray": uniform(rng, 0.0, 1.0, *size), "others": uniform(rng, 0.0, 1.0, count, *other_size)}
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
    label = f"{by(*size)}, {count} of {by(*other_size)}, {', '.join([f'{planes} planes', *weighted])}"
    return Draw(inputs, {"step": 0.7 / (planes - 1), "planes": planes}, label=label)


def find_doubtful(function, drawn):
    """Returns the mask of the pixels that rounding may decide, [1, 1, H, W], the last result of `function`."""
    inputs = {name: torch.tensor(value).double() for name, value in drawn.inputs.items()}
    return function(**inputs, **drawn.config)[-1].numpy()[None, None]


def as_images(function):
    """Makes a search for depths return its other results, as [1, 1, H, W]."""

    @wraps(function)
    def evaluate(**inputs):
        return tuple(value[None, None] for value in function(**inputs)[:2])

    return evaluate


@case(as_images(search.search), "inverse_depth", "correlation")
def depth_search(rng):
    """Photos of which some have weights.

    The kernel processes a vector of columns and eight planes at a time; the sizes are around multiples of these.
    """
    for shapes in [
        ((9, 9), (9, 9), 1, 2),
        ((20, 33), (27, 41), 2, 9),
        ((24, 32), (24, 32), 4, 16),
        ((19, 47), (24, 31), 5, 11, "weight"),
        ((30, 17), (21, 50), 3, 8, "other_weights"),
        ((26, 30), (26, 30), 4, 10, "weight", "other_weights"),
    ]:
        drawn = photos_to_compare(rng, *shapes)
        drawn.doubtful = find_doubtful(search.search, drawn)
        yield drawn


MATCHING = Tolerance(
    5e-5,
    0.0,
    why="variances of patches with little texture are small differences of means, and a small margin between planes is one of costs",
)


@case(as_images(search.match_semi_globally), "inverse_depth", "confidence", tolerance=MATCHING)
def semi_global_matching(rng):
    """Photos like those of depth_search, half of the first without texture.

    The kernel processes a vector of planes at a time; their numbers are around multiples of it.
    """
    for shapes in [
        ((9, 9), (9, 9), 1, 2),
        ((12, 25), (14, 21), 2, 9),
        ((16, 18), (16, 18), 4, 33),
        ((19, 15), (12, 17), 5, 16, "weight"),
        ((15, 22), (15, 22), 4, 17, "weight", "other_weights"),
    ]:
        # Rounding must not decide whether a pixel counts.
        for _ in range(100):
            drawn = photos_to_compare(rng, *shapes)
            drawn.inputs["gray"][:, : shapes[0][1] // 2] *= 0.02
            drawn.doubtful = find_doubtful(search.match_semi_globally, drawn)
            if not drawn.doubtful.all():
                break
        yield drawn
