"""Gaussians and cameras for the rasterizer, in float64: random and adversarial scenes.

RANDOM, ADVERSARIAL, THIN and LONE map a label to ((height, width), function of a random generator and that size).
"""

from functools import partial

import numpy as np

from . import draw

EPS_2D = 0.05


def settings(size, antialiased=False):
    return {"height": size[0], "width": size[1], "eps2d": EPS_2D, "antialiased": antialiased}


def scattered(rng, size, batch, cameras, count, bases):
    """Returns Gaussians of sizes from below a pixel to a third of the image, some outside of it, of all opacities."""
    height, width = size
    depth = rng.uniform(1.0, 5.0, (batch, count, 1))
    pixels = np.exp(rng.uniform(np.log(0.3), np.log(0.3 * max(size) + 1.0), (batch, count, 3)))
    return {
        "means": np.concatenate([rng.uniform(-0.8, 0.8, (batch, count, 2)) * depth, depth], axis=-1),
        "scales": pixels * depth / max(size),
        "quaternions": rng.uniform(0.2, 3.0) * rng.standard_normal((batch, count, 4)),
        "opacities": rng.uniform(0.0, 1.0, (batch, count)),
        "sh": 0.3 * rng.standard_normal((batch, count, bases, 3)),
        "w2c": draw.inverse(draw.poses(rng, batch, cameras, turn=0.08, move=0.2)),
        "intrinsics": draw.intrinsics(rng, batch, cameras, height=height, width=width),
    }


def random_scene(size, batch, cameras, count, bases):
    label = f"{batch}×{cameras} views of {size[0]}×{size[1]}, {count} Gaussians, {bases} bases"
    return label, (size, partial(scattered, batch=batch, cameras=cameras, count=count, bases=bases))


RANDOM = dict(
    [
        random_scene((24, 40), batch=2, cameras=2, count=50, bases=16),
        random_scene((31, 19), batch=1, cameras=3, count=30, bases=9),
        random_scene((16, 16), batch=3, cameras=1, count=20, bases=4),
        random_scene((9, 50), batch=1, cameras=1, count=40, bases=1),
    ]
)
ADVERSARIAL = {
    "1×1": ((1, 1), partial(scattered, batch=2, cameras=2, count=12, bases=4)),
    "3×17": ((3, 17), partial(scattered, batch=1, cameras=2, count=20, bases=16)),
}
# Gaussians hundreds of times longer than wide, for which float32 has few significant digits.
THIN = {
    "255×257": ((255, 257), partial(scattered, batch=1, cameras=1, count=24, bases=16)),
}

# Scenes of one Gaussian each, which culling could lose.
LONE = {}


def scene(label, family=ADVERSARIAL, size=(33, 48)):
    def register(function):
        family[f"{label}, {size[0]}×{size[1]}"] = (size, function)
        return function

    return register


def in_front_of_cameras(rng, size, means, scales, opacities, cameras=1):
    """Places Gaussians in front of cameras with w2c = I; other cameras are 1/4 to the left and 1/2 ahead.

    Depths are exact, also in float32. The focal length is 32 and the principal point is the image center.
    """
    height, width = size
    means = np.asarray(means, dtype=np.float64)
    count = len(means)
    w2c = np.tile(np.eye(4), (1, cameras, 1, 1))
    w2c[:, 1:, :3, 3] = (0.25, 0.0, -0.5)
    k = np.array([[32.0, 0.0, width / 2], [0.0, 32.0, height / 2], [0.0, 0.0, 1.0]])
    return {
        "means": means[None],
        "scales": np.broadcast_to(np.asarray(scales, dtype=np.float64), (1, count, 3)).copy(),
        "quaternions": rng.standard_normal((1, count, 4)),
        "opacities": np.broadcast_to(np.asarray(opacities, dtype=np.float64), (1, count)).copy(),
        "sh": 0.3 * rng.standard_normal((1, count, 9, 3)),
        "w2c": w2c,
        "intrinsics": np.tile(k, (1, cameras, 1, 1)),
    }


def means_in_view(rng, depth, spread=0.6):
    """Returns means at the given depths, within the field of view of `in_front_of_cameras` and a little beyond it."""
    depth = np.asarray(depth, dtype=np.float64)[:, None]
    return np.concatenate([spread * rng.uniform(-1.0, 1.0, (len(depth), 2)) * depth, depth], axis=-1)


@scene("near plane")
def near_plane(rng, size):
    """Three Gaussians at each of several depths around the near plane, some at the camera center."""
    just_above = np.nextafter(np.float32(0.01), np.float32(1))
    depth = np.repeat([-3.0, -0.01, 0.0, 1e-9, 0.0099, 0.01, just_above, 0.0101, 0.02, 0.1], 3)
    scales = rng.uniform(0.05, 0.4, (len(depth), 3)) * np.maximum(np.abs(depth), 1e-3)[:, None]
    return in_front_of_cameras(rng, size, means_in_view(rng, depth), scales, 0.4)


@scene("far outside")
def far_outside(rng, size):
    tangent = rng.uniform(-1.0, 1.0, (24, 2)) * np.repeat([2.0, 10.0, 1000.0], 8)[:, None]
    depth = rng.uniform(1.0, 3.0, (24, 1))
    scales = depth * np.abs(tangent).max(-1, keepdims=True) * rng.uniform(0.1, 1.0, (24, 3))
    return in_front_of_cameras(rng, size, np.concatenate([tangent * depth, depth], axis=-1), scales, 0.5, cameras=2)


@scene("needles and discs", THIN)
def needles(rng, size):
    kinds = [[1e-7, 1e-7, 1.0], [1.0, 1e-7, 1.0], [1e-3, 1e-4, 0.5], [1e-12, 1e-12, 1e-12]]
    return in_front_of_cameras(rng, size, means_in_view(rng, rng.uniform(1.0, 3.0, 24)), np.tile(kinds, (6, 1)), 0.5)


@scene("alone", LONE, size=(33, 50))
def alone(rng, size):
    """Needles of any direction, large, tiny and faint Gaussians, with centers on borders of blocks and outside the image."""
    count, center = 36, np.array([size[1], size[0]]) / 2
    pixels = np.array([[3.0, 3.0], [60.0, 0.05], [200.0, 0.3], [0.02, 0.02], [8.0, 1.0], [300.0, 40.0]])
    opacities = np.repeat([0.99, 0.5, 1.02 / 255, 0.05, 1.0, 4 / 255], 6)
    places = rng.uniform(-1.0, 3.0, (count, 2)) * center
    places[::3] = 4.0 * np.round(places[::3] / 4.0)
    means = np.concatenate([(places - center) / 32.0, np.ones((count, 1))], axis=-1)
    scales = np.concatenate([np.tile(pixels, (6, 1)) / 32.0, np.full((count, 1), 1e-4)], axis=-1)
    inputs = in_front_of_cameras(rng, size, means, scales, opacities)
    turn = rng.uniform(0.0, np.pi, count) / 2
    inputs["quaternions"][0] = np.stack([np.cos(turn), 0 * turn, 0 * turn, np.sin(turn)], axis=-1)
    cameras = {name: np.repeat(inputs[name], count, axis=0) for name in ("w2c", "intrinsics")}
    return {name: np.swapaxes(value, 0, 1) for name, value in inputs.items()} | cameras


@scene("huge")
def huge(rng, size):
    scales = 10.0 ** rng.uniform(1.0, 3.0, (8, 1)) * rng.uniform(0.5, 1.5, (8, 3))
    return in_front_of_cameras(rng, size, means_in_view(rng, rng.uniform(1.0, 3.0, 8)), scales, 0.3)


def quaternions_of_length(length):
    @scene(f"quaternions of length {length:g}")
    def make(rng, size):
        means = means_in_view(rng, rng.uniform(1.0, 3.0, 24))
        inputs = in_front_of_cameras(rng, size, means, rng.uniform(0.02, 0.3, (24, 3)), 0.5)
        return inputs | {"quaternions": length * inputs["quaternions"]}


# One draw per norm, because the gradients of the shortest quaternions dominate those of the others.
for length in (1e-30, 1e-20, 1e20, 1e30):
    quaternions_of_length(length)


@scene("opacity 0 to 1")
def opacities(rng, size):
    opacity = np.tile([0.0, 1e-12, 0.0039, 0.0040, 0.5, 1.0], 4)  # 1/255 is 0.00392
    means = means_in_view(rng, rng.uniform(1.0, 3.0, 24))
    return in_front_of_cameras(rng, size, means, rng.uniform(0.02, 0.3, (24, 3)), opacity)


@scene("equal depths")
def equal_depths(rng, size):
    means = means_in_view(rng, np.full(30, 2.0))
    means[20:] = means[:10]
    return in_front_of_cameras(rng, size, means, rng.uniform(0.05, 0.4, (30, 3)), rng.uniform(0.1, 0.9, 30), cameras=2)


@scene("tile borders")
def tile_borders(rng, size):
    """Centers at multiples of 16 pixels and on the image borders: (u, v) = 16 (x, y) + (24, 16.5) at depth 2."""
    u, v = np.meshgrid([0.0, 16.0, 32.0, 48.0], [0.0, 16.0, 16.5, 32.0, 33.0])
    means = np.stack([(u.ravel() - 24.0) / 16.0, (v.ravel() - 16.5) / 16.0, np.full(u.size, 2.0)], axis=-1)
    scales = np.tile([[0.001], [0.0625], [1.0], [0.5]], (5, 1))
    return in_front_of_cameras(rng, size, means, scales[rng.permutation(20)], rng.uniform(0.1, 0.9, 20))


@scene("opaque stack")
def opaque_stack(rng, size):
    means = means_in_view(rng, np.linspace(1.0, 4.0, 60), spread=0.2)
    return in_front_of_cameras(rng, size, means, 1.0, rng.uniform(0.3, 1.0, 60))


@scene("all behind")
def all_behind(rng, size):
    return in_front_of_cameras(rng, size, means_in_view(rng, np.full(5, -2.0)), 0.3, 0.9)


@scene("no Gaussian")
def no_gaussian(rng, size):
    return in_front_of_cameras(rng, size, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
