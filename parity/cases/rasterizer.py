"""Cases of the rasterizer, in float64 and float32.

A pixel is doubtful if an alpha is within `margin` (relative) of 1/255 or of the cap 0.999, a transmittance is within
`margin` of 1e-4, or the depths of two Gaussians that both contribute to it differ by less than a hundredth of `margin`
without being equal. Rounding may then decide, and neither the pixel nor its gradient can be compared.
"""

import numpy as np
import torch

from ..harness import scenes
from ..harness.compare import FLOAT64, Tolerance
from ..harness.registry import Draw, case
from ..reference import splat

RASTERIZER_FLOAT32 = Tolerance(
    1e-5,
    3e-4,
    images=1e-4,
    why="a gradient sums terms of both signs over all pixels of a Gaussian, and 1 - T has few digits where little is "
    "covered; 2.4e-4 is the largest over 8 seeds",
)
# Relative distances from a threshold within which rounding may decide.
DOUBT = {np.float64: 1e-9, np.float32: 5e-4}
MOST_TRIES = 100  # maximum number of attempts to draw a scene without doubtful pixels


def map_cameras(inputs, function):
    """Calls function(Gaussians of a scene, w2c, intrinsics) -> dict for every camera; stacks values to [B, C, ...]."""
    rows = []
    for b in range(inputs["w2c"].shape[0]):
        scene = [inputs[name][b] for name in ("means", "scales", "quaternions", "opacities", "sh")]
        cameras = zip(inputs["w2c"][b], inputs["intrinsics"][b], strict=True)
        rows.append([function(*scene, w2c, intrinsics) for w2c, intrinsics in cameras])
    return {key: torch.stack([torch.stack([seen[key] for seen in row]) for row in rows]) for key in rows[0][0]}


def doubtful_pixels(config, inputs, margin):
    """Returns the mask of doubtful pixels, bool [B, C, H, W], for the arrays of a request."""
    pixels = splat.pixel_centers(config["width"], config["height"], torch.float64)

    def doubtful(means, scales, quaternions, opacities, sh, w2c, intrinsics):
        seen = splat.project(means, scales, quaternions, w2c, intrinsics, **config)
        found = doubtful_in_view(seen, opacities * seen["compensation"], pixels, margin)
        return {"doubtful": found.reshape(config["height"], config["width"])}

    doubles = {name: torch.tensor(array).double() for name, array in inputs.items()}
    return map_cameras(doubles, doubtful)["doubtful"].numpy()


def doubtful_in_view(projected, opacities, pixels, margin):
    """Returns the mask of doubtful pixels of one view, bool [Q], by the rules of splat.composite."""
    order, alpha = splat.alphas(projected, opacities, pixels)
    depth = projected["depth"][order]

    def near(value, threshold):
        return (value / threshold - 1.0).abs() < margin

    reaches = alpha >= splat.SMALLEST_ALPHA
    passed = torch.where(reaches, 1.0 - alpha.clamp(max=splat.LARGEST_ALPHA), 1.0)
    after = torch.cumprod(passed, dim=0)
    goes_on = torch.cat([torch.ones_like(after[:1]), after[:-1]]) > splat.SMALLEST_TRANSMITTANCE * (1.0 - margin)

    steps = near(alpha, splat.SMALLEST_ALPHA) | near(alpha, splat.LARGEST_ALPHA)
    steps |= near(after, splat.SMALLEST_TRANSMITTANCE)
    doubtful = (steps & goes_on).any(0)

    gap = depth[1:] - depth[:-1]
    unordered = (gap > 0) & (gap < 0.01 * margin * depth[1:])
    both = reaches[1:] & reaches[:-1] & goes_on[1:]
    return doubtful | (both & unordered[:, None]).any(0)


def render(config, inputs):
    def of_camera(*scene_and_camera):
        rgb, alpha, depth = splat.render(*scene_and_camera, **config)
        return {"rgb": rgb.movedim(-1, 0), "alpha": alpha, "depth": depth}

    return map_cameras(inputs, of_camera)


DIFFERENTIATE = ("means", "scales", "quaternions", "sh", "w2c", "opacities")


def rasterizations(name, dtype, family, tolerance, antialiased=False):
    """Registers a case of a family of scenes.

    Float64 scenes are drawn again until they have no doubtful pixels. Float32 scenes have a mask of doubtful pixels,
    whose cotangents are 0.
    """

    def draws(rng):
        for label, (size, make) in family.items():
            config = scenes.settings(size, antialiased)
            for _ in range(MOST_TRIES):
                inputs = {key: value.astype(dtype) for key, value in make(rng, size).items()}
                doubtful = doubtful_pixels(config, inputs, DOUBT[dtype])
                if dtype == np.float32 or not doubtful.any():
                    break
            else:
                raise RuntimeError(f"{label}: every one of {MOST_TRIES} scenes has a pixel on a threshold")
            yield Draw(inputs, config, {}, DIFFERENTIATE, label=label, doubtful=doubtful)

    draws.__name__ = name
    case(render, module="rasterizer", tolerance=tolerance)(draws)


ORDINARY, ALL = scenes.RANDOM | scenes.ADVERSARIAL, scenes.RANDOM | scenes.ADVERSARIAL | scenes.THIN
# Float64 is precise enough for thin Gaussians, too. Needles and discs have tiny determinants of projected covariances,
# by which antialiasing reduces opacities.
rasterizations("rasterizer", np.float64, ALL | scenes.LONE, FLOAT64)
rasterizations("rasterizer_float32", np.float32, ORDINARY | scenes.THIN | scenes.LONE, RASTERIZER_FLOAT32)
rasterizations("rasterizer_antialiased", np.float64, ALL, FLOAT64, antialiased=True)
rasterizations("rasterizer_antialiased_float32", np.float32, ORDINARY, RASTERIZER_FLOAT32, antialiased=True)


def fitted_colors(config, inputs):
    names = ("means", "scales", "quaternions", "opacities", "sh", "w2c", "intrinsics", "images", "masks")
    *gaussians, w2cs, intrinsics, images, masks = (inputs[name][0] for name in names)
    contributions, sh = splat.fit_colors(gaussians, w2cs, intrinsics, images, masks, config["steps"])
    return contributions[None], sh[None]


@case(fitted_colors, "contributions", "sh", tolerance=FLOAT64)
def color_fit(rng):
    """Spherical harmonics of all degrees, fitted to images of which some pixels count half or not at all."""
    for size, cameras, count, bases in [((24, 20), 2, 30, 16), ((16, 16), 3, 20, 4), ((9, 30), 1, 12, 1)]:
        config = scenes.settings(size)
        inputs = scenes.scattered(rng, size, 1, cameras, count, bases)
        while doubtful_pixels(config, inputs, DOUBT[np.float64]).any():
            inputs = scenes.scattered(rng, size, 1, cameras, count, bases)
        images = {
            "images": rng.uniform(0.0, 1.0, (1, cameras, 3, *size)),
            "masks": rng.choice([0.0, 0.5, 1.0], (1, cameras, 1, *size)),
        }
        label = f"{cameras} views of {size[0]}×{size[1]}, {bases} bases"
        yield Draw(inputs | images, config | {"steps": 6}, label=label)
