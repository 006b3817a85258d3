"""Cases of the tokenizer, from images and cameras to the tokens that the encoder reads."""

import numpy as np

from ... import reference
from ...reference.names import reference_config, with_prefix
from .. import draw
from ..draw import integer, normal, uniform
from ..registry import Draw, by, case, reference_for


@case
def patchify(rng):
    """Patches of one pixel and more, for several numbers of channels. The program takes channels as the last axis."""
    for shape, patch in [((1, 1, 4, 4, 3), 2), ((2, 3, 6, 15, 6), 3), ((1, 2, 5, 3, 2), 1)]:
        label = f"{by(*shape)}, patch {patch}"
        yield Draw(label, {"xs": normal(rng, *shape)}, {"patch_size": patch}, differentiate=("xs",))


@reference_for("patchify")
def patchify_reference(config, params, inputs):
    return {"tokens": reference.tokens.patchify(inputs["xs"].movedim(-1, 2), config["patch_size"])}


@case
def rgb_tokens(rng):
    """The RGB half of the tokens, which does not depend on the cameras."""
    for _ in range(3):
        config = draw.model_config(rng)
        _, inputs = draw.pictures(rng, config, integer(rng, 1, 3), integer(rng, 1, 4))
        images = {"images": inputs["images"]}
        params = {"rgb_patch_embeds.1.weight": draw.parameters(rng, config)["rgb_patch_embeds.1.weight"]}
        label = f"{by(*images['images'].shape)}, patch {config['patch_size']}"
        yield Draw(label, images, config, params, ("images",))


@reference_for("rgb_tokens")
def rgb_tokens_reference(config, params, inputs):
    return {"tokens": reference.tokens.rgb_tokens(params, inputs["images"], config["patch_size"])}


@case
def ray_tokens(rng):
    """The ray half of the tokens, with and without the camera code."""
    for code in (True, True, False):
        config = draw.model_config(rng, camera_code=code)
        image, inputs = draw.pictures(rng, config, integer(rng, 1, 3), integer(rng, 1, 4))
        inputs.pop("images")
        params = draw.parameters(rng, config)
        params = {name: value for name, value in params.items() if name.startswith(("ray_patch_embeds", "view_pe"))}
        label = f"{by(*inputs['c2w'].shape[:2], *image)}, {'camera code' if code else 'no camera code'}"
        yield Draw(label, inputs, config | {"image": image}, params)


@reference_for("ray_tokens")
def ray_tokens_reference(config, params, inputs):
    tokens = reference.tokens.ray_tokens(
        params, inputs["c2w"], inputs["intrinsics"], *config["image"], config["patch_size"], config["camera_code"]
    )
    return {"tokens": tokens}


@case
def rays(rng):
    """Plücker coordinates of every pixel, for images of one pixel and more."""
    for batch, count, image in [(1, 1, (1, 1)), (2, 3, (7, 12)), (1, 4, (33, 17))]:
        yield Draw(by(batch, count, *image), draw.views(rng, batch, count, *image), {"image": image})


@reference_for("rays")
def rays_reference(config, params, inputs):
    rays = reference.rays.plucker_rays(inputs["c2w"], inputs["intrinsics"], *config["image"])
    return {"rays": rays.movedim(2, -1)}


@case
def radial_warp(rng):
    """The warp of scenes to one distance: rays, cameras, and Gaussians moved back. Some scenes have no sure depth."""
    for batch, count, image, sure in [(1, 2, (12, 16), 1.0), (2, 3, (24, 20), 1.0), (1, 3, (9, 9), 0.0)]:
        views = draw.views(rng, batch, count, *image)
        inverse = uniform(rng, 0.02, 1.0, batch, count, 1, *image)
        depths = np.concatenate([inverse, sure * uniform(rng, 0.0, 1.0, *inverse.shape)], 2)
        gaussians = {"means": normal(rng, batch, 40, 3), "scales": uniform(rng, 0.01, 0.1, batch, 40, 3)}
        label = f"{by(batch, count, *image)}{'' if sure else ', nothing sure'}"
        yield Draw(label, views | {"depths": depths.astype(np.float32)} | gaussians, differentiate=tuple(gaussians))


@reference_for("radial_warp")
def radial_warp_reference(config, params, inputs):
    c2w, intrinsics = inputs["c2w"], inputs["intrinsics"]
    warp = reference.warp.RadialWarp(c2w, intrinsics, inputs["depths"])
    means, scales = warp.restore(inputs["means"], inputs["scales"])
    return {"rays": warp.rays(c2w, intrinsics), "cameras": warp.cameras(c2w), "means": means, "scales": scales}


@case
def camera_code(rng):
    """Camera codes of views, for several image sizes, by which intrinsics are normalized."""
    for batch, count, image in [(1, 1, (8, 8)), (2, 5, (24, 40)), (3, 2, (256, 256))]:
        config = draw.model_config(rng)
        params = draw.parameters(rng, config, "view_pe.")
        inputs = draw.views(rng, batch, count, *image)
        yield Draw(f"{by(batch, count)}, image {by(*image)}", inputs, config | {"image": image}, params)


@reference_for("camera_code")
def camera_code_reference(config, params, inputs):
    params = with_prefix("view_pe", params)
    return {"code": reference.rays.camera_code(params, inputs["c2w"], inputs["intrinsics"], *config["image"])}


@case
def tokens(rng):
    """Both halves of the tokens, with and without the camera code."""
    for code in (True, True, False):
        config = draw.model_config(rng, camera_code=code)
        _, inputs = draw.pictures(rng, config, integer(rng, 1, 3), integer(rng, 1, 4))
        params = draw.parameters(rng, config)
        tokenizer = ("rgb_patch_embeds", "ray_patch_embeds", "view_pe")
        params = {name: value for name, value in params.items() if name.startswith(tokenizer)}
        label = f"{by(*inputs['images'].shape)}, {'camera code' if code else 'no camera code'}"
        yield Draw(label, inputs, config, params, ("images",))


@reference_for("tokens")
def tokens_reference(config, params, inputs):
    tokens = reference.tokens.view_tokens(
        reference_config(config), params, inputs["images"], inputs["c2w"], inputs["intrinsics"]
    )
    return {"tokens": tokens}
