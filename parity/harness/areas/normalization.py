"""Cases of scene normalization from the cameras."""

import reference.normalize

from .. import draw
from ..draw import integer
from ..registry import Draw, case, reference_for
from ..tolerance import FLOAT64


@case
def scene_normalization(rng):
    """Random and degenerate cameras.

    One camera, or several at one position, have no extent to divide by. Cameras around an object have no mean
    direction.
    """
    for count in (1, 2, 7, 36):
        c2w = draw.poses(rng, count, turn=0.4, move=integer(rng, 1, 20))
        yield Draw(f"{count} cameras", {"c2w": c2w}, tolerance=FLOAT64)
    together = draw.poses(rng, 3)
    together[:, :3, 3] = together[0, :3, 3]
    yield Draw("3 cameras in one place", {"c2w": together}, tolerance=FLOAT64)
    tiny = draw.poses(rng, 5)
    tiny[:, :3, 3] *= 1e-13
    yield Draw("5 cameras in a large unit", {"c2w": tiny}, tolerance=FLOAT64)
    for tilt in (0.0, 0.6):
        around = draw.ring(8, tilt)
        yield Draw(f"8 cameras around a thing, tilted by {tilt}", {"c2w": around}, tolerance=FLOAT64)


@reference_for("scene_normalization")
def scene_normalization_reference(config, params, inputs):
    c2w, _, scale = reference.normalize.normalize_scene(inputs["c2w"])
    return {"c2w": c2w, "scale": scale}
