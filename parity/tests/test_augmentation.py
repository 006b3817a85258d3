"""Tests of the reference's resizing against Pillow, and of simple properties of its color jitter."""

import numpy as np
import pytest
import torch
from PIL import Image

from parity.reference import jitter, resample


def saturated(rng, height, width):
    """Returns an image with edges from 0 to 255, at which the filter overshoots."""
    return (rng.random((height, width, 3)) < 0.5).astype(np.uint8) * 255


def smooth(rng, height, width):
    coarse = Image.fromarray(rng.integers(0, 256, (4, 5, 3), dtype=np.uint8))
    return np.asarray(coarse.resize((width, height), Image.Resampling.BICUBIC))


@pytest.mark.parametrize("draw", [saturated, smooth])
@pytest.mark.parametrize(
    "shape, region, size",
    [
        ((36, 64), (0.0, 0.0, 64.0, 36.0), (26, 46)),
        ((36, 64), (14.0, 0.0, 36.0, 36.0), (26, 26)),
        ((45, 80), (20.3, 1.7, 40.2, 41.9), (31, 29)),
        ((20, 11), (0.0, 0.0, 11.0, 20.0), (50, 33)),
        ((9, 7), (0.0, 0.0, 7.0, 9.0), (2, 1)),
    ],
)
def test_resampling_is_pillow_s(draw, shape, region, size):
    image = draw(np.random.default_rng(0), *shape)
    left, top, width, height = region
    theirs = Image.fromarray(image).resize(
        size[::-1], Image.Resampling.LANCZOS, box=(left, top, left + width, top + height)
    )
    ours = resample.resample(torch.tensor(image), region, *size)
    difference = np.abs(ours.movedim(0, -1).numpy() - np.asarray(theirs, dtype=np.float64))
    # Pillow's weights have 22 bits, so a value about halfway between two levels may be rounded to the other one.
    assert difference.max() <= 1.0 and (difference > 0).mean() < 1e-2


def test_a_third_of_the_circle_swaps_the_colors():
    image = torch.rand(3, 5, 7, dtype=torch.float64)
    assert torch.allclose(jitter.hue(image, 1.0 / 3.0), image[[2, 0, 1]], atol=1e-12)


def test_jitter_of_no_strength_changes_nothing():
    image = torch.rand(3, 5, 7, dtype=torch.float64)
    nothing = [("brightness", 1.0), ("contrast", 1.0), ("saturation", 1.0), ("hue", 0.0)]
    assert torch.allclose(jitter.jitter(image, nothing), image, atol=1e-12)
