"""Cases of the preprocessing and augmentation of photos."""

import numpy as np
import reference.jitter
import reference.resample

from ..draw import uniform
from ..registry import Draw, by, case, reference_for
from ..tolerance import Tolerance

RESAMPLE = Tolerance(
    3e-4,
    0.0,
    why="results are rounded to 8 bits, so a value near a rounding boundary may differ by one level; 3e-4 allows this for one value in 700",
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
