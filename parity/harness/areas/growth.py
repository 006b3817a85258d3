"""Cases of the conversion of a smaller model's weights to a larger one's."""

from ... import reference
from ..draw import normal
from ..registry import Draw, case, reference_for


@case
def growth(rng):
    """Patch edges divided by 2, 3 and 4, and up to four copies of each scene token; one draw changes neither."""
    for patch, patch_size_ratio, latent_ratio, channels in [(4, 2, 2, 3), (9, 3, 3, 6), (8, 4, 4, 3), (5, 1, 1, 3)]:
        width, latents, candidates = 7, 5, 4
        inputs = {
            "patch_weights": normal(rng, width, patch * patch * channels),
            "scene_tokens": normal(rng, latents, width),
            "noise": normal(rng, latent_ratio * latents, width),
            "bias": normal(rng, 10 * candidates),
        }
        label = f"patch {patch} to {patch // patch_size_ratio}, {latents} tokens to {latent_ratio * latents}"
        config = {"patch_size": patch, "patch_size_ratio": patch_size_ratio, "latent_ratio": latent_ratio}
        yield Draw(label, inputs, config, differentiate=tuple(inputs))


@reference_for("growth")
def growth_reference(config, params, inputs):
    return {
        "patch_weights": reference.growth.shrink_patch_weights(
            inputs["patch_weights"], config["patch_size"], config["patch_size_ratio"]
        ),
        "scene_tokens": reference.growth.repeat_scene_tokens(inputs["scene_tokens"], inputs["noise"]),
        "bias": reference.growth.split_opacity_bias(inputs["bias"], config["latent_ratio"]),
    }
