"""Cases of the complete model, from images to Gaussians."""

from ... import reference
from ...reference.names import reference_config
from .. import draw
from ..draw import integer, uniform
from ..registry import Draw, by, case, reference_for
from .decoder import decoder_params, gaussians


@case
def model(rng):
    """Small models and ablations, at the start of a curriculum transition (mix 0), within one (0.3) and after one (1)."""
    for stage, mix, fixed in [
        (0, 1.0, {}),
        (2, 0.3, {"candidates": 8, "sh_degree": 3}),
        (1, 1.0, {"streams": "single"}),
        (1, 0.0, {"camera_code": False}),
    ]:
        config = draw.model_config(rng, **fixed)
        _, inputs = draw.pictures(rng, config, integer(rng, 1, 2), integer(rng, 1, 3))
        suffix = "" if config["camera_code"] else ", no camera code"
        label = f"{by(*inputs['images'].shape)}, stage {stage}, λ {mix}, {config['streams']}{suffix}"
        params = draw.parameters(rng, config)
        yield Draw(label, inputs, config | {"stage": stage, "mix": mix}, params, ("images",))


@case
def model_16k(rng):
    """A model of the published size, 84 million parameters."""
    inputs = {"images": uniform(rng, 0.0, 1.0, 1, 4, 3, 256, 256)} | draw.views(rng, 1, 4, 256, 256)
    yield Draw(
        f"{by(*inputs['images'].shape)}, stage 3, λ 1.0",
        inputs,
        draw.MAIN_16K | {"stage": 3, "mix": 1.0},
        draw.parameters(rng, draw.MAIN_16K),
        ("images",),
        module="model",
        large=True,
    )


@reference_for("model")
def model_reference(config, params, inputs):
    params = decoder_params(params, inputs["images"])
    decoded = reference.model.forward(
        reference_config(config),
        params,
        inputs["images"],
        inputs["c2w"],
        inputs["intrinsics"],
        config["stage"],
        config["mix"],
    )
    return gaussians(decoded)
