"""Cases of the decoder, from latents to Gaussians: heads, merging of candidates, rotations."""

from itertools import product

import numpy as np
import torch

from ... import reference
from ...reference.names import reference_config, with_prefix
from .. import draw
from ..draw import integer, normal, uniform
from ..registry import Draw, by, case, reference_for

# Constant offset of the decoder, which is not a parameter: program and reference each define it.
MEAN_OFFSET = (0.0, 0.0, 1.5)
# Names of the reference, and those of the program.
MERGED = {
    "position": "positions",
    "log_scale": "log_scales",
    "rotation": "rotations",
    "opacity": "opacity_logits",
    "sh": "sh",
}


def latents(rng, config, batch):
    shape = batch, config["latents"], config["width"]
    return {"geometry": normal(rng, *shape), "appearance": normal(rng, *shape)}


def decoder_params(params, like):
    offset = torch.tensor(MEAN_OFFSET, dtype=like.dtype).reshape(1, 1, 3)
    return params | {"gaussian_decoder.patch_center_bias": offset}


def gaussians(decoded):
    return {
        "means": decoded["means"],
        "scales": decoded["scales"],
        "rotations_6d": decoded["rotations_6d"],
        "quaternions": decoded["quats_wxyz"],
        "opacities": decoded["opacities"].squeeze(-1),
        "sh": decoded["sh"],
    }


def stages_of(candidates):
    """Returns (stage, mix) for every stage, at the start of, in and after its transition."""
    return product(range(int(np.log2(candidates)) + 1), (0.0, 0.3, 1.0))


@case
def heads(rng):
    """Outputs of the heads for every candidate, before clamps, for each degree of spherical harmonics."""
    for degree in range(4):
        config = draw.model_config(rng, sh_degree=degree)
        inputs = latents(rng, config, integer(rng, 1, 3))
        params = draw.parameters(rng, config, "gaussian_decoder.")
        label = f"{by(*inputs['geometry'].shape)}, K {config['candidates']}, degree {degree}"
        yield Draw(label, inputs, config, params, ("geometry", "appearance"))


@reference_for("heads")
def heads_reference(config, params, inputs):
    params = with_prefix("gaussian_decoder", params)
    raw = reference.decoder.heads(reference_config(config), params, inputs["geometry"], inputs["appearance"])
    return {
        "positions": raw["position"],
        "log_scales": raw["log_scale"] + reference.decoder.LOG_SCALE_OFFSET,
        "rotations": raw["rotation"],
        "opacity_logits": raw["opacity"],
        "gate": raw["gate"],
        "sh": raw["sh"].flatten(-2),
    }


@case
def merge(rng):
    """Merging of values from the whole range within the clamps, at every stage of the curriculum."""
    for candidates in (2, 16):
        for stage, mix in stages_of(candidates):
            shape = integer(rng, 1, 2), integer(rng, 3, 9), candidates
            inputs = {
                "positions": normal(rng, *shape, 3),
                "log_scales": uniform(rng, -10.2, -1.0, *shape, 3),
                "rotations": normal(rng, *shape, 6),
                "opacity_logits": uniform(rng, -13.0, 6.0, *shape, 1),
                "sh": normal(rng, *shape, 3 * integer(rng, 1, 4) ** 2),
                "gate": normal(rng, *shape),
            }
            label = f"{by(*shape)}, stage {stage}, λ {mix}"
            yield Draw(label, inputs, {"stage": stage, "mix": mix}, differentiate=tuple(inputs))


@reference_for("merge")
def merge_reference(config, params, inputs):
    full = {theirs: inputs[ours] for theirs, ours in MERGED.items()}
    merged = reference.decoder.merge_with_transition(full, inputs["gate"], config["stage"], config["mix"])
    return {MERGED[name]: value for name, value in merged.items()}


@case
def decoder(rng):
    """The complete decoder at every stage of the curriculum."""
    for candidates in (2, 16):
        for stage, mix in stages_of(candidates):
            config = draw.model_config(rng, candidates=candidates)
            inputs = latents(rng, config, integer(rng, 1, 2))
            params = draw.parameters(rng, config, "gaussian_decoder.")
            label = f"{by(*inputs['geometry'].shape)}, K {candidates}, stage {stage}, λ {mix}"
            config |= {"stage": stage, "mix": mix}
            yield Draw(label, inputs, config, params, ("geometry", "appearance"))


@reference_for("decoder")
def decoder_reference(config, params, inputs):
    geometry, appearance = inputs["geometry"], inputs["appearance"]
    params = decoder_params(with_prefix("gaussian_decoder", params), geometry)
    decoded = reference.decoder.decode(
        reference_config(config), params, geometry, appearance, config["stage"], config["mix"]
    )
    return gaussians(decoded)


def rotations(rng):
    """Yields 6D rotations: random ones, the identity, and rotations by 180°, whose quaternion has no real part."""
    yield normal(rng, 3, 17, 6)
    yield normal(rng, 50, 6)
    yield normal(rng, 2, 2, 5, 6, scale=0.1) + np.float32([1, 0, 0, 0, 1, 0])
    turns = [[1, 0, 0, 0, 1, 0], [1, 0, 0, 0, -1, 0], [-1, 0, 0, 0, 1, 0], [-1, 0, 0, 0, -1, 0]]
    yield np.float32(turns) * np.float32([[0.5], [1], [2], [3]])


@case
def rotation_matrix(rng):
    """Matrices of 6D rotations, which are the first two rows before orthonormalization."""
    for six in rotations(rng):
        yield Draw(by(*six.shape), {"rotations": six}, differentiate=("rotations",))


@reference_for("rotation_matrix")
def rotation_matrix_reference(config, params, inputs):
    return {"matrix": reference.rotation.matrix_from_6d(inputs["rotations"])}


@case
def quaternion(rng):
    """Quaternions of the 6D rotations of `rotation_matrix`."""
    for six in rotations(rng):
        yield Draw(by(*six.shape), {"rotations": six}, differentiate=("rotations",))


@reference_for("quaternion")
def quaternion_reference(config, params, inputs):
    matrix = reference.rotation.matrix_from_6d(inputs["rotations"])
    return {"quaternion": reference.rotation.quaternion_from_matrix(matrix)}
