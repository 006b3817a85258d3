"""Cases of projection and rasterizer, in float64 and float32."""

import numpy as np
import torch

from ... import reference
from .. import scenes
from ..registry import Draw, case, reference_for
from ..thresholds import MOST_TRIES, doubtful_pixels
from ..tolerance import FLOAT32, FLOAT64, Tolerance

PROJECTION_THIN_FLOAT32 = Tolerance(
    1e-5,
    2e-3,
    why="the gradients of a Gaussian hundreds of times longer than wide are small differences of large terms; "
    "7e-4 measured, about as much as by the reference in float32",
)
RASTERIZER_FLOAT32 = Tolerance(
    1e-5,
    3e-4,
    pictures=1e-4,
    why="a gradient sums terms of both signs over all pixels of a Gaussian, and 1 - T has few digits where little is "
    "covered; 2.4e-4 is the largest over 8 seeds",
)
# Relative distances from a threshold within which rounding may decide.
DOUBT = {np.float64: 1e-9, np.float32: 5e-4}


def splat_draws(rng, module, dtype, family, tolerance, antialiased=False):
    """Yields draws of a family of scenes.

    Float64 scenes are drawn again until they have no doubtful pixels. Float32 scenes have a mask of doubtful pixels,
    whose cotangents are 0.
    """
    differentiate = ("means", "scales", "quaternions", "sh", "w2c")
    if module == "rasterizer":
        differentiate += ("opacities",)
    for label, (size, make) in family.items():
        config = scenes.settings(size, antialiased)
        for _ in range(MOST_TRIES):
            inputs = {name: value.astype(dtype) for name, value in make(rng, size).items()}
            doubtful = doubtful_pixels(config, inputs, DOUBT[dtype]) if module == "rasterizer" else None
            if doubtful is None or dtype == np.float32 or not doubtful.any():
                break
        else:
            raise RuntimeError(f"{label}: every one of {MOST_TRIES} scenes has a pixel on a threshold")
        yield Draw(
            label, inputs, config, differentiate=differentiate, module=module, tolerance=tolerance, doubtful=doubtful
        )


def map_cameras(inputs, function):
    """Calls function(Gaussians of a scene, w2c, intrinsics) -> dict for every camera; stacks values to [B, C, ...]."""
    rows = []
    for b in range(inputs["w2c"].shape[0]):
        scene = [inputs[name][b] for name in ("means", "scales", "quaternions", "opacities", "sh")]
        cameras = zip(inputs["w2c"][b], inputs["intrinsics"][b], strict=True)
        rows.append([function(*scene, w2c, intrinsics) for w2c, intrinsics in cameras])
    return {key: torch.stack([torch.stack([seen[key] for seen in row]) for row in rows]) for key in rows[0][0]}


@case
def projection(rng):
    """Projection of all scenes: float64 is precise enough for thin Gaussians, too."""
    family = scenes.RANDOM | scenes.ADVERSARIAL | scenes.THIN
    yield from splat_draws(rng, "projection", np.float64, family, FLOAT64)


@case
def projection_float32(rng):
    """Projection of the scenes for which float32 is precise enough."""
    yield from splat_draws(rng, "projection", np.float32, scenes.RANDOM | scenes.ADVERSARIAL, FLOAT32)


@case
def projection_thin_float32(rng):
    yield from splat_draws(rng, "projection", np.float32, scenes.THIN, PROJECTION_THIN_FLOAT32)


@reference_for("projection")
def projection_reference(config, params, inputs):
    settings = config["width"], config["height"], config["eps2d"], config["antialiased"]

    def project(means, scales, quaternions, opacities, sh, w2c, intrinsics):
        seen = reference.splat.project(means, scales, quaternions, w2c, intrinsics, *settings)
        visible = seen["visible"] & (opacities * seen["compensation"] >= reference.splat.SMALLEST_ALPHA)
        color = reference.splat.sh_color(means, sh, w2c)
        return {
            "visible": visible.long(),
            "mean2d": torch.where(visible[:, None], seen["mean2d"], 0.0),
            "conic": torch.where(visible[:, None], seen["conic"], 0.0),
            "depth": torch.where(visible, seen["depth"], 0.0),
            "color": torch.where(visible[:, None], color, 0.0),
        }

    return map_cameras(inputs, project)


@case
def rasterizer(rng):
    """Ordinary scenes of several sizes; adversarial scenes are separate cases."""
    yield from splat_draws(rng, "rasterizer", np.float64, scenes.RANDOM, FLOAT64)


@case
def rasterizer_adversarial(rng):
    yield from splat_draws(rng, "rasterizer", np.float64, scenes.ADVERSARIAL | scenes.THIN, FLOAT64)


@case
def rasterizer_float32(rng):
    yield from splat_draws(rng, "rasterizer", np.float32, scenes.RANDOM, RASTERIZER_FLOAT32)


@case
def rasterizer_adversarial_float32(rng):
    yield from splat_draws(rng, "rasterizer", np.float32, scenes.ADVERSARIAL, RASTERIZER_FLOAT32)


@case
def rasterizer_thin_float32(rng):
    yield from splat_draws(rng, "rasterizer", np.float32, scenes.THIN, RASTERIZER_FLOAT32)


@case
def rasterizer_antialiased(rng):
    """Opacities reduced by the determinants of the projected covariances, which needles and discs have tiny ones of."""
    family = scenes.RANDOM | scenes.ADVERSARIAL | scenes.THIN
    yield from splat_draws(rng, "rasterizer", np.float64, family, FLOAT64, antialiased=True)


@case
def rasterizer_antialiased_float32(rng):
    family = scenes.RANDOM | scenes.ADVERSARIAL
    yield from splat_draws(rng, "rasterizer", np.float32, family, RASTERIZER_FLOAT32, antialiased=True)


@reference_for("rasterizer")
def rasterizer_reference(config, params, inputs):
    def render(*scene_and_camera):
        rgb, alpha, depth = reference.splat.render(
            *scene_and_camera, config["width"], config["height"], config["eps2d"], config["antialiased"]
        )
        return {"rgb": rgb.movedim(-1, 0), "alpha": alpha, "depth": depth}

    return map_cameras(inputs, render)


@case
def color_fit(rng):
    """Spherical harmonics of all degrees, fitted to images of which some pixels count half or not at all."""
    shapes = [((24, 20), 2, 30, 16), ((16, 16), 3, 20, 4), ((9, 30), 1, 12, 1)]
    family = dict(scenes.random_scene(size, 1, *counts) for size, *counts in shapes)
    for scene in splat_draws(rng, "rasterizer", np.float64, family, FLOAT64):
        cameras, size = scene.inputs["w2c"].shape[1], (scene.config["height"], scene.config["width"])
        images = {
            "images": rng.uniform(0.0, 1.0, (1, cameras, 3, *size)),
            "masks": rng.choice([0.0, 0.5, 1.0], (1, cameras, 1, *size)),
        }
        yield Draw(scene.label, scene.inputs | images, scene.config | {"steps": 6}, tolerance=FLOAT64)


@reference_for("color_fit")
def color_fit_reference(config, params, inputs):
    names = ("means", "scales", "quaternions", "opacities", "sh", "w2c", "intrinsics", "images", "masks")
    *gaussians, w2cs, intrinsics, images, masks = (inputs[name][0] for name in names)
    contributions, sh = reference.color_fit.fit_colors(gaussians, w2cs, intrinsics, images, masks, config["steps"])
    return {"contributions": contributions[None], "sh": sh[None]}
