"""Cases of the model, from images to Gaussians, as a whole and in its three parts, and of what surrounds it."""

from itertools import product

import numpy as np

from ..harness import draw
from ..harness.compare import FLOAT64
from ..harness.draw import integer, normal, uniform
from ..harness.registry import Draw, by, case
from ..reference.decoder import decode
from ..reference.encoder import encode
from ..reference.model import forward
from ..reference.normalize import normalize_scene
from ..reference.tokens import view_tokens
from ..reference.warp import RadialWarp


@case(view_tokens, "tokens")
def tokens(rng):
    """The tokens of images of one patch and more, with and without the camera code."""
    for code in (True, True, True, False, False):
        config = draw.model_config(rng, camera_code=code)
        inputs = draw.images(rng, config, integer(rng, 1, 3), integer(rng, 1, 4))
        params = draw.parameters(rng, config, "rgb_patch_embeds", "ray_patch_embeds", "view_pe")
        label = f"{by(*inputs['images'].shape)}, patch {config['patch_size']}{'' if code else ', no camera code'}"
        yield Draw(inputs, config, params, ("images",), label=label)


@case(encode, "geometry", "appearance")
def encoder(rng):
    """The encoder, with two streams and with the ablation's single stream."""
    for streams in ("dual", "dual", "dual", "dual", "single", "single"):
        config = draw.model_config(rng, streams=streams)
        shape = integer(rng, 1, 3), integer(rng, 4, 40), config["ray_width"] + config["rgb_width"]
        params = draw.parameters(rng, config, "scene_tokens", "slot_encoder")
        label = f"{by(*shape)}, slots {by(config['latents'], config['width'])}, rounds {config['rounds']}, {streams}"
        yield Draw({"tokens": normal(rng, *shape)}, config, params, ("tokens",), label=label)


@case(decode)
def decoder(rng):
    """The decoder at every stage of the curriculum: at the start of its transition (mix 0), within and after it (1)."""
    for candidates in (2, 16):
        for stage, mix in product(range(int(np.log2(candidates)) + 1), (0.0, 0.3, 1.0)):
            config = draw.model_config(rng, candidates=candidates)
            shape = integer(rng, 1, 2), config["latents"], config["width"]
            inputs = {"geometry": normal(rng, *shape), "appearance": normal(rng, *shape)}
            params = draw.parameters(rng, config, "gaussian_decoder.")
            label = f"{by(*shape)}, K {candidates}, degree {config['sh_degree']}, stage {stage}, λ {mix}"
            config |= {"stage": stage, "mix": mix}
            yield Draw(inputs, config, params, tuple(inputs), prefix="gaussian_decoder.", label=label)


@case(forward)
def model(rng):
    """Small models and ablations, at the start of a curriculum transition (mix 0), within one (0.3) and after one (1)."""
    for stage, mix, fixed in [
        (0, 1.0, {}),
        (2, 0.3, {"candidates": 8, "sh_degree": 3}),
        (1, 1.0, {"streams": "single"}),
        (1, 0.0, {"camera_code": False}),
    ]:
        config = draw.model_config(rng, **fixed)
        inputs = draw.images(rng, config, integer(rng, 1, 2), integer(rng, 1, 3))
        label = ", ".join([by(*inputs["images"].shape), f"stage {stage}, λ {mix}", *map(str, fixed.values())])
        yield Draw(
            inputs, config | {"stage": stage, "mix": mix}, draw.parameters(rng, config), ("images",), label=label
        )


@case(forward, module="model")
def model_16k(rng):
    """A model of the published size, 84 million parameters."""
    inputs = {"images": uniform(rng, 0.0, 1.0, 1, 4, 3, 256, 256)} | draw.views(rng, 1, 4, 256, 256)
    config = draw.MAIN_16K | {"stage": 3, "mix": 1.0}
    params = draw.parameters(rng, config)
    yield Draw(inputs, config, params, ("images",), label="4 views of 256×256, stage 3, λ 1.0", is_large=True)


def warp(c2w, intrinsics, depths, means, scales):
    found = RadialWarp(c2w, intrinsics, depths)
    return found.rays(c2w, intrinsics), found.cameras(c2w), *found.restore(means, scales)


@case(warp, "rays", "cameras", "means", "scales")
def radial_warp(rng):
    """The warp of scenes to one distance: rays, cameras, and Gaussians moved back. Some scenes have no sure depth."""
    for batch, count, image, sure in [(1, 2, (12, 16), 1.0), (2, 3, (24, 20), 1.0), (1, 3, (9, 9), 0.0)]:
        views = draw.views(rng, batch, count, *image)
        inverse = uniform(rng, 0.02, 1.0, batch, count, 1, *image)
        depths = np.concatenate([inverse, sure * uniform(rng, 0.0, 1.0, *inverse.shape)], 2)
        gaussians = {"means": normal(rng, batch, 40, 3), "scales": uniform(rng, 0.01, 0.1, batch, 40, 3)}
        inputs = views | {"depths": depths.astype(np.float32)} | gaussians
        yield Draw(inputs, differentiate=tuple(gaussians), label=f"{by(batch, count, *image)}, confidence {sure}")


def normalized_poses(c2w):
    c2w, _, scale = normalize_scene(c2w)
    return c2w, scale


@case(normalized_poses, "c2w", "scale", tolerance=FLOAT64)
def scene_normalization(rng):
    """Random and degenerate cameras.

    One camera, or several at one position, have no extent to divide by. In a level ring around the origin the viewing
    directions cancel out; in a tilted ring their mean is parallel to the mean down vector, so there is no right vector.
    """
    for count in (1, 2, 7, 36):
        yield Draw({"c2w": draw.poses(rng, count, turn=0.4, move=integer(rng, 1, 20))})
    coincident = draw.poses(rng, 3)
    coincident[:, :3, 3] = coincident[0, :3, 3]
    yield Draw({"c2w": coincident}, label="3 cameras at one position")
    scaled = draw.poses(rng, 5)
    scaled[:, :3, 3] *= 1e-13
    yield Draw({"c2w": scaled}, label="5 cameras, positions scaled by 1e-13")
    for elevation in (0.0, 0.6):
        yield Draw({"c2w": draw.ring(8, elevation)}, label=f"8 cameras around the origin, elevation {elevation} rad")
