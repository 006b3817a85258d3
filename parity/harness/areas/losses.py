"""Cases of the terms of the training objective that need no trained network."""

import numpy as np

from ... import reference
from .. import draw
from ..draw import integer, normal, uniform
from ..registry import Draw, by, case, reference_for


@case
def mse(rng):
    """Mean squared error of batches and of a single pixel."""
    for shape in [(1, 1, 3, 1, 1), (2, 3, 3, 7, 12)]:
        images = {"rendered": uniform(rng, 0.0, 1.0, *shape), "truth": uniform(rng, 0.0, 1.0, *shape)}
        yield Draw(by(*shape), images, differentiate=("rendered",))


@reference_for("mse")
def mse_reference(config, params, inputs):
    return {"loss": reference.loss.mse.mse(inputs["rendered"], inputs["truth"])}


@case
def frustum(rng):
    """Points around the cameras, none within 0.05 of a camera's plane, where pixel coordinates lose all precision."""
    for batch, count, points, image in [(1, 1, 40, (16, 16)), (2, 3, 60, (24, 40)), (3, 4, 25, (31, 17))]:
        w2c = draw.inverse(draw.poses(rng, batch, count))
        means = rng.uniform(-4.0, 4.0, (batch, points, 3)) + np.array([0.0, 0.0, 2.0])
        depth = np.einsum("bvc,bnc->bvn", w2c[..., 2, :3], means) + w2c[..., 2, 3, None]
        means[np.abs(depth).min(1) < 0.05] = (0.1, -0.1, 2.5)
        inputs = {
            "means": means,
            "w2c": w2c,
            "intrinsics": draw.intrinsics(rng, batch, count, height=image[0], width=image[1]),
            "far": rng.uniform(2.0, 5.0, batch),
        }
        inputs = {name: value.astype(np.float32) for name, value in inputs.items()}
        label = f"{by(batch, count)}, {points} points, image {by(*image)}"
        yield Draw(label, inputs, {"image": image}, differentiate=("means",))


@reference_for("frustum")
def frustum_reference(config, params, inputs):
    loss = reference.loss.frustum.frustum(
        inputs["means"], inputs["w2c"], inputs["intrinsics"], *config["image"], inputs["far"]
    )
    return {"loss": loss}


@case
def sh_soft_cap(rng):
    """Coefficients on both sides of the cap, which is 5."""
    for shape in [(1, 1, 1, 3), (2, 5, 4, 27)]:
        yield Draw(by(*shape), {"sh": normal(rng, *shape, scale=5.0)}, differentiate=("sh",))


@reference_for("sh_soft_cap")
def sh_soft_cap_reference(config, params, inputs):
    return {"loss": reference.loss.decoder_regularization.sh_soft_cap(inputs["sh"])}


@case
def decoder_regularization(rng):
    """Scales, coefficients and opacities on both sides of their thresholds."""
    for opacity in (True, False):
        shape = integer(rng, 1, 3), integer(rng, 2, 9), integer(rng, 1, 16)
        inputs = {
            "log_scales": normal(rng, *shape, 3, scale=3.0, mean=-3.0),
            "rotations": normal(rng, *shape, 6),
            "sh": normal(rng, *shape, 27, scale=5.0),
            "opacity_logits": uniform(rng, -13.0, 6.0, *shape, 1),
        }
        label = f"{by(*shape)}, {'with' if opacity else 'without'} opacity"
        yield Draw(label, inputs, {"opacity": opacity}, differentiate=tuple(inputs))


@reference_for("decoder_regularization")
def decoder_regularization_reference(config, params, inputs):
    raw = {
        "log_scale": inputs["log_scales"],
        "rotation": inputs["rotations"],
        "sh": inputs["sh"],
        "opacity_logit": inputs["opacity_logits"],
    }
    return {"loss": reference.loss.decoder_regularization.decoder_regularization(raw, config["opacity"])}


@case
def consistency(rng):
    """Renders with a fifth of the pixels below the opacity at which depth counts; in one draw, all pixels."""
    for shape, empty, factors in [
        ((1, 1, 4, 4), 0.2, (1e-3, 1e-2)),
        ((2, 3, 7, 12), 0.2, (1.0, 0.5)),
        ((1, 2, 3, 5), 1.0, (1.0, 1.0)),
    ]:

        def alpha(shape=shape, empty=empty):
            return uniform(rng, 0.02, 1.0, *shape) * np.where(rng.random(shape) < empty, 0.005, 1.0).astype(np.float32)

        inputs = {
            "alpha_a": alpha(),
            "alpha_b": alpha(),
            "depth_a": uniform(rng, 0.5, 5.0, *shape),
            "depth_b": uniform(rng, 0.5, 5.0, *shape),
        }
        config = {"alpha_factor": factors[0], "depth_factor": factors[1]}
        label = f"{by(*shape)}, factors {factors[0]:g} and {factors[1]:g}"
        yield Draw(label, inputs, config, differentiate=tuple(inputs))


@reference_for("consistency")
def consistency_reference(config, params, inputs):
    loss = reference.loss.consistency.consistency(
        inputs["alpha_a"],
        inputs["alpha_b"],
        inputs["depth_a"],
        inputs["depth_b"],
        config["alpha_factor"],
        config["depth_factor"],
    )
    return {"loss": loss}


@case
def ssim(rng):
    """Image pairs that share half of their signal, because the SSIM of unrelated images is nearly 0 and has no
    precision.

    C1 only matters in dark images. An identical pair has no gradient, so one is tested together with another pair.
    """

    def half_alike(*shape):
        truth = uniform(rng, 0.0, 1.0, *shape)
        return 0.5 * truth + uniform(rng, 0.0, 0.5, *shape), truth

    pairs = {by(*shape): half_alike(*shape) for shape in [(1, 3, 11, 11), (1, 3, 13, 20), (3, 3, 25, 17)]}
    pairs["1×3×14×13, dark"] = [np.float32(0.05) * pictures for pictures in half_alike(1, 3, 14, 13)]
    truth = uniform(rng, 0.2, 0.8, 1, 3, 15, 18)
    pairs["1×3×15×18, nearly equal"] = truth + uniform(rng, -0.02, 0.02, *truth.shape), truth
    picture, truth = half_alike(2, 3, 12, 16)
    picture[1] = truth[1]
    pairs["2×3×12×16, one pair identical"] = picture, truth
    for label, (picture, truth) in pairs.items():
        yield Draw(label, {"picture": picture, "truth": truth}, differentiate=("picture",))
    yield Draw("2×3×12×16, identical", {"picture": truth, "truth": truth})


@reference_for("ssim")
def ssim_reference(config, params, inputs):
    return {"ssim": reference.loss.ssim.ssim(inputs["picture"], inputs["truth"])}


@case
def photometric(rng):
    """L1 and SSIM in one pass, alone and combined.

    The kernel processes sixteen rows and a vector of columns at a time; the sizes are around multiples of these. The
    weights avoid sums that nearly cancel, which would have no precision.
    """
    for shape, absolute, similar in [
        ((1, 3, 11, 40), 1.0, 0.0),
        ((2, 3, 26, 27), 0.8, 0.2),
        ((1, 3, 33, 16), 0.1, -0.9),
        ((1, 2, 3, 17, 43), 0.5, 0.5),
    ]:
        truth = uniform(rng, 0.0, 1.0, *shape)
        picture = 0.5 * truth + uniform(rng, 0.0, 0.5, *shape)
        config = {"absolute": absolute, "similar": similar}
        label = f"{by(*shape)}, {absolute:g} and {similar:g}"
        yield Draw(label, {"picture": picture, "truth": truth}, config=config, differentiate=("picture",))


@reference_for("photometric")
def photometric_reference(config, params, inputs):
    picture, truth = (inputs[name].flatten(0, -4) for name in ("picture", "truth"))
    difference = (picture - truth).abs().mean()
    return {"loss": config["absolute"] * difference + config["similar"] * reference.loss.ssim.ssim(picture, truth)}


@case
def depth_smoothness(rng):
    """Depth steps, some at edges of the photo, and pixels without depth.

    The kernel processes sixteen rows and a vector of columns at a time; the sizes are around multiples of these.
    """
    for shape, factor in [((1, 1, 1), 1.0), ((2, 17, 43), 0.7), ((1, 2, 33, 16), 3.0), ((1, 40, 1), 1.0)]:
        photo = uniform(rng, 0.0, 1.0, *shape[:-2], 3, *shape[-2:])
        depth = uniform(rng, 0.5, 8.0, *shape) * (uniform(rng, 0.0, 1.0, *shape) < 0.9)
        config = {"factor": factor}
        yield Draw(by(*shape), {"depth": depth, "photo": photo}, config=config, differentiate=("depth",))


@reference_for("depth_smoothness")
def depth_smoothness_reference(config, params, inputs):
    return {
        "loss": config["factor"] * reference.loss.depth_smoothness.depth_smoothness(inputs["depth"], inputs["photo"])
    }


def masks(rng, *shape):
    """Returns weights of 0 on the left, 1 on the right, and random ones between; those of the first image are 0."""
    weights = np.clip(np.linspace(-1.0, 2.0, shape[-1]) + uniform(rng, -0.2, 0.2, *shape), 0.0, 1.0)
    if shape[0] > 1:
        weights[0] = 0.0
    return weights


@case
def masked_mse(rng):
    """Mean squared error of images of which parts are masked out, and one as a whole."""
    for shape in [(1, 1, 3, 5, 4), (2, 3, 3, 7, 12)]:
        images = {"rendered": uniform(rng, 0.0, 1.0, *shape), "truth": uniform(rng, 0.0, 1.0, *shape)}
        images["mask"] = masks(rng, *shape[:-3], 1, *shape[-2:])
        yield Draw(by(*shape), images, differentiate=("rendered",))


@reference_for("masked_mse")
def masked_mse_reference(config, params, inputs):
    return {"loss": reference.loss.mask.masked_mse(inputs["rendered"], inputs["truth"], inputs["mask"])}


@case
def masked_photometric(rng):
    """L1 and SSIM of images of which parts are masked out, and one as a whole."""
    for shape, absolute, similar in [
        ((1, 3, 11, 40), 1.0, 0.0),
        ((2, 3, 26, 27), 0.8, 0.2),
        ((1, 3, 33, 16), 0.6, -0.4),
        ((2, 2, 3, 17, 43), 0.5, 0.5),
    ]:
        truth = uniform(rng, 0.0, 1.0, *shape)
        inputs = {"picture": 0.5 * truth + uniform(rng, 0.0, 0.5, *shape), "truth": truth}
        inputs["mask"] = masks(rng, *shape[:-3], 1, *shape[-2:])
        config = {"absolute": absolute, "similar": similar}
        label = f"{by(*shape)}, {absolute:g} and {similar:g}"
        yield Draw(label, inputs, config=config, differentiate=("picture",))


@reference_for("masked_photometric")
def masked_photometric_reference(config, params, inputs):
    picture, truth, mask = (inputs[name].flatten(0, -4) for name in ("picture", "truth", "mask"))
    weight = reference.loss.mask.mean_weight(mask)
    difference = (mask * (picture - truth).abs()).mean() / weight
    similarity = reference.loss.mask.masked_ssim(picture, truth, mask, reference.loss.ssim.ssim)
    return {"loss": config["absolute"] * difference + config["similar"] * similarity}


@case
def masked_depth_smoothness(rng):
    """Depth steps, some at masked pixels, and pixels without depth. No weight is near the threshold of one half."""
    for shape, factor in [((2, 17, 43), 0.7), ((1, 2, 33, 16), 3.0)]:
        photo = uniform(rng, 0.0, 1.0, *shape[:-2], 3, *shape[-2:])
        depth = uniform(rng, 0.5, 8.0, *shape) * (uniform(rng, 0.0, 1.0, *shape) < 0.9)
        mask = masks(rng, *shape)
        mask[np.abs(mask - 0.5) < 0.05] = 0.75
        inputs = {"depth": depth, "photo": photo, "mask": mask}
        yield Draw(by(*shape), inputs, config={"factor": factor}, differentiate=("depth",))


@reference_for("masked_depth_smoothness")
def masked_depth_smoothness_reference(config, params, inputs):
    counts = (inputs["mask"] >= 0.5).to(inputs["depth"].dtype)
    loss = reference.loss.depth_smoothness.depth_smoothness(inputs["depth"] * counts, inputs["photo"])
    return {"loss": config["factor"] * loss / reference.loss.mask.mean_weight(counts)}
