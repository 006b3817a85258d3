"""Cases of scene normalization from the cameras."""

from ... import reference
from .. import draw
from ..draw import integer
from ..registry import Draw, case, reference_for
from ..tolerance import FLOAT64


@case
def scene_normalization(rng):
    """Random and degenerate cameras.

    One camera, or several at one position, have no extent to divide by. In a level ring around the origin the viewing
    directions cancel out; in a tilted ring their mean is parallel to the mean down vector, so there is no right vector.
    """
    for count in (1, 2, 7, 36):
        c2w = draw.poses(rng, count, turn=0.4, move=integer(rng, 1, 20))
        yield Draw(f"{count} cameras", {"c2w": c2w}, tolerance=FLOAT64)
    coincident = draw.poses(rng, 3)
    coincident[:, :3, 3] = coincident[0, :3, 3]
    yield Draw("3 cameras at one position", {"c2w": coincident}, tolerance=FLOAT64)
    scaled = draw.poses(rng, 5)
    scaled[:, :3, 3] *= 1e-13
    yield Draw("5 cameras, positions scaled by 1e-13", {"c2w": scaled}, tolerance=FLOAT64)
    for elevation in (0.0, 0.6):
        ring = draw.ring(8, elevation)
        yield Draw(f"8 cameras around the origin, elevation {elevation} rad", {"c2w": ring}, tolerance=FLOAT64)


@reference_for("scene_normalization")
def scene_normalization_reference(config, params, inputs):
    c2w, _, scale = reference.normalize.normalize_scene(inputs["c2w"])
    return {"c2w": c2w, "scale": scale}
