"""Cases of the conversion of a smaller model's weights to a larger one's."""

import reference.growth

from ..draw import normal
from ..registry import Draw, case, reference_for


@case
def growth(rng):
    """Patches of 1/2, 1/3 and 1/4 of the edge, up to four scene tokens for one; one draw keeps both unchanged."""
    for patch, times, copies, channels in [(4, 2, 2, 3), (9, 3, 3, 6), (8, 4, 4, 3), (5, 1, 1, 3)]:
        width, latents, candidates = 7, 5, 4
        inputs = {
            "patch_weights": normal(rng, width, patch * patch * channels),
            "scene_tokens": normal(rng, latents, width),
            "noise": normal(rng, copies * latents, width),
            "bias": normal(rng, 10 * candidates),
        }
        label = f"patch {patch} to {patch // times}, {latents} tokens to {copies * latents}"
        yield Draw(label, inputs, {"patch_size": patch, "times": times, "copies": copies}, differentiate=tuple(inputs))


@reference_for("growth")
def growth_reference(config, params, inputs):
    return {
        "patch_weights": reference.growth.for_smaller_patches(
            inputs["patch_weights"], config["patch_size"], config["times"]
        ),
        "scene_tokens": reference.growth.more_tokens(inputs["scene_tokens"], inputs["noise"]),
        "bias": reference.growth.shared_opacities(inputs["bias"], config["copies"]),
    }
