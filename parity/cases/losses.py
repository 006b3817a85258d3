"""Cases of the terms of the training objective."""

import numpy as np

from ..harness import draw
from ..harness.draw import integer, normal, uniform
from ..harness.registry import Draw, by, case
from ..reference import losses
from ..reference import perceptual as networks


def masks(rng, *shape):
    """Returns weights of 0 on the left, 1 on the right, and random ones between; those of the first image are 0."""
    weights = np.clip(np.linspace(-1.0, 2.0, shape[-1]) + uniform(rng, -0.2, 0.2, *shape), 0.0, 1.0)
    if shape[0] > 1:
        weights[0] = 0.0
    return weights.astype(np.float32)


@case(losses.mse)
def mse(rng):
    """Mean squared error of batches and of a single pixel, without masks and with one that leaves out an image as a whole."""
    for shape, is_masked in [
        ((1, 1, 3, 1, 1), False),
        ((2, 3, 3, 7, 12), False),
        ((1, 1, 3, 5, 4), True),
        ((2, 3, 3, 7, 12), True),
    ]:
        images = {name: uniform(rng, 0.0, 1.0, *shape) for name in ("image", "ground_truth")}
        mask = {"mask": masks(rng, *shape[:-3], 1, *shape[-2:])} if is_masked else {}
        yield Draw(images | mask, differentiate=("image",))


@case(losses.frustum)
def frustum(rng):
    """Points around the cameras, none within 0.05 of a camera's plane, where pixel coordinates lose all precision."""
    for batch, count, points, size in [(1, 1, 40, (16, 16)), (2, 3, 60, (24, 40)), (3, 4, 25, (31, 17))]:
        w2c = draw.inverse(draw.poses(rng, batch, count))
        means = rng.uniform(-4.0, 4.0, (batch, points, 3)) + np.array([0.0, 0.0, 2.0])
        depth = np.einsum("bvc,bnc->bvn", w2c[..., 2, :3], means) + w2c[..., 2, 3, None]
        means[np.abs(depth).min(1) < 0.05] = (0.1, -0.1, 2.5)
        inputs = {
            "means": means,
            "w2c": w2c,
            "intrinsics": draw.intrinsics(rng, batch, count, height=size[0], width=size[1]),
            "far": rng.uniform(2.0, 5.0, batch),
        }
        inputs = {name: value.astype(np.float32) for name, value in inputs.items()}
        yield Draw(inputs, {"image_size": size}, differentiate=("means",))


@case(losses.decoder_regularization)
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
        yield Draw(inputs, {"opacity": opacity}, differentiate=tuple(inputs))


@case(losses.consistency)
def consistency(rng):
    """Renders with a fifth of the pixels below the opacity at which depth counts; in one draw, all pixels."""
    for shape, empty, factors in [
        ((1, 1, 4, 4), 0.2, (1e-3, 1e-2)),
        ((2, 3, 7, 12), 0.2, (1.0, 0.5)),
        ((1, 2, 3, 5), 1.0, (1.0, 1.0)),
    ]:
        inputs = {}
        for name in ("alpha_a", "alpha_b"):
            inputs[name] = uniform(rng, 0.02, 1.0, *shape)
            inputs[name][rng.random(shape) < empty] *= 0.005
        inputs |= {name: uniform(rng, 0.5, 5.0, *shape) for name in ("depth_a", "depth_b")}
        config = {"alpha_factor": factors[0], "depth_factor": factors[1]}
        yield Draw(inputs, config, differentiate=tuple(inputs))


def half_alike(rng, *shape):
    """Returns an image pair that shares half of its signal.

    The SSIM of unrelated images is nearly 0 and has no precision.
    """
    ground_truth = uniform(rng, 0.0, 1.0, *shape)
    return {"image": 0.5 * ground_truth + uniform(rng, 0.0, 0.5, *shape), "ground_truth": ground_truth}


@case(losses.ssim, "ssim")
def ssim(rng):
    """Images of different sizes, dark ones, in which alone C1 matters, and nearly equal ones.

    An identical pair has no gradient, so one is tested together with another pair.
    """
    for shape in [(1, 3, 11, 11), (1, 3, 13, 20), (3, 3, 25, 17)]:
        yield Draw(half_alike(rng, *shape), differentiate=("image",))
    dark = {name: np.float32(0.05) * value for name, value in half_alike(rng, 1, 3, 14, 13).items()}
    yield Draw(dark, differentiate=("image",), label="1×3×14×13, dark")
    ground_truth = uniform(rng, 0.2, 0.8, 1, 3, 15, 18)
    pair = {"image": ground_truth + uniform(rng, -0.02, 0.02, *ground_truth.shape), "ground_truth": ground_truth}
    yield Draw(pair, differentiate=("image",), label="1×3×15×18, nearly equal")
    pair = half_alike(rng, 2, 3, 12, 16)
    pair["image"][1] = pair["ground_truth"][1]
    yield Draw(pair, differentiate=("image",), label="2×3×12×16, one pair identical")
    yield Draw({"image": pair["ground_truth"], "ground_truth": pair["ground_truth"]}, label="2×3×12×16, identical")


# The kernels process sixteen rows and a vector of columns at a time; the sizes are around multiples of these. The weights
# avoid sums that nearly cancel, which would have no precision.
PHOTOMETRIC = [((1, 3, 11, 40), 1.0, 0.0), ((2, 3, 26, 27), 0.8, 0.2), ((1, 2, 3, 17, 43), 0.5, 0.5)]


@case(losses.photometric)
def photometric(rng):
    """L1 and SSIM in one pass, alone and combined, without masks and with one that leaves out an image as a whole."""
    for other, is_masked in [(((1, 3, 33, 16), 0.1, -0.9), False), (((2, 3, 33, 16), 0.6, -0.4), True)]:
        for shape, l1_weight, ssim_weight in [*PHOTOMETRIC, other]:
            inputs = half_alike(rng, *shape)
            if is_masked:
                inputs["mask"] = masks(rng, *shape[:-3], 1, *shape[-2:])
            yield Draw(inputs, {"l1_weight": l1_weight, "ssim_weight": ssim_weight}, differentiate=("image",))


def photos_with_depth(rng, *shape):
    """Returns depth steps, some at edges of the photo, and pixels without depth."""
    photo = uniform(rng, 0.0, 1.0, *shape[:-2], 3, *shape[-2:])
    depth = uniform(rng, 0.5, 8.0, *shape) * (uniform(rng, 0.0, 1.0, *shape) < 0.9)
    return {"depth": depth, "photo": photo}


@case(losses.depth_smoothness)
def depth_smoothness(rng):
    """Depths of a pixel and more, with sizes around multiples of the kernel's, and some with masked pixels."""
    for shape, factor in [((1, 1, 1), 1.0), ((2, 17, 43), 0.7), ((1, 2, 33, 16), 3.0), ((1, 40, 1), 1.0)]:
        yield Draw(photos_with_depth(rng, *shape), {"factor": factor}, differentiate=("depth",))
    for shape, factor in [((2, 17, 43), 0.7), ((1, 2, 33, 16), 3.0)]:
        mask = masks(rng, *shape)
        mask[np.abs(mask - 0.5) < 0.05] = 0.75  # away from the threshold of one half
        yield Draw(photos_with_depth(rng, *shape) | {"mask": mask}, {"factor": factor}, differentiate=("depth",))


# ---- features of networks --------------------------------------------------------------------------------------------
#
# A gradient is a step function of the image where a value before a ReLU changes its sign, where another value becomes the
# maximum of a pooling window, or where the sign of a difference of features changes. Float32 decides some of them
# otherwise than the reference, so only values are compared in float32, and gradients of networks in float64.


def in_both_precisions(inputs, config, params, differentiate, label):
    def doubles(group):
        return {name: value.astype(np.float64) for name, value in group.items()}

    yield Draw(inputs, config, params, label=f"{label}, float32", has_gradients=False)
    yield Draw(doubles(inputs), config, doubles(params), differentiate, label=label)


def lpips_draws(rng, network, shapes, dead=()):
    """Yields draws of images. Layers in `dead` have all-zero features, whose norm has no derivative."""
    params = draw.lpips_parameters(rng, network)
    for name in dead:
        params[f"{name}.bias"] -= np.float32(100.0)
    for shape in shapes:
        inputs = {name: uniform(rng, 0.0, 1.0, *shape) for name in ("image", "ground_truth")}
        label = by(*shape) + "".join(f", {name} dead" for name in dead)
        yield from in_both_precisions(inputs, {"network": network}, params, tuple(inputs), label)


@case(networks.lpips, "distance", module="lpips")
def lpips_vgg(rng):
    """LPIPS with VGG on images of the smallest height that its poolings support."""
    yield from lpips_draws(rng, "lpips_vgg", [(2, 3, 16, 19)])


@case(networks.lpips, "distance", module="lpips")
def lpips_alex(rng):
    """LPIPS with AlexNet on the smallest images, on odd sizes, and with zero features."""
    yield from lpips_draws(rng, "lpips_alex", [(1, 3, 31, 31), (2, 3, 49, 36)])
    yield from lpips_draws(rng, "lpips_alex", [(1, 3, 47, 63)], dead=("conv5",))


@case(networks.perceptual)
def perceptual(rng):
    """Two sets of renders of the same targets, with one target and with several, of the smallest sizes and of odd ones.

    The network's weights are inputs that take no gradient.
    """
    vgg19, alex = draw.vgg19_parameters(rng), draw.lpips_parameters(rng, "lpips_alex")
    for kind, weights, targets, size in [
        ("vgg19", vgg19, 2, (16, 16)),
        ("vgg19", vgg19, 1, (19, 17)),
        ("lpips_alex", alex, 1, (31, 31)),
    ]:
        inputs = {
            "image": uniform(rng, 0.0, 1.0, 2, targets, 3, *size),
            "ground_truth": uniform(rng, 0.0, 1.0, 1, targets, 3, *size),
        }
        label = f"{kind}, {by(targets, 3, *size)}"
        yield from in_both_precisions(inputs | weights, {"kind": kind}, {}, ("image",), label)
