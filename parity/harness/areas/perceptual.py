"""Cases of the losses that compare the features of trained networks."""

import numpy as np

from ... import reference
from .. import draw
from ..close_calls import ON_CPU, ON_GPU, calls_within, closest, decisions_of_lpips, decisions_of_vgg19
from ..draw import uniform
from ..registry import Draw, by, case, reference_for
from ..thresholds import MOST_TRIES
from ..tolerance import Tolerance

# The weights take no gradient in training, but have one here, for which cuDNN uses a special algorithm for 5×5 kernels.
ON_GPU_TOLERANCE = Tolerance(
    1e-5,
    1e-3,
    why="cuDNN's gradients of 5×5 kernels: 1.3e-4 measured, where those of their biases and of the picture have 2e-6",
)


def draw_without_close_calls(rng, decisions, *shapes):
    """Draws random images of these shapes until no decision is a close call on a CPU.

    Returns the images, and a function that returns the close calls on a GPU.
    """
    for _ in range(MOST_TRIES):
        pictures = [uniform(rng, 0.0, 1.0, *shape) for shape in shapes]
        if closest(decisions(*pictures)) > ON_CPU:
            return pictures, lambda pictures=pictures: calls_within(ON_GPU, decisions(*pictures))
    raise RuntimeError(f"every one of {MOST_TRIES} sets of pictures has a close call")


def lpips_draws(rng, network, shapes, dead=()):
    """Yields draws of images without close calls of ReLUs and poolings. Layers in `dead` have all-zero features."""
    params = draw.lpips_parameters(rng, network)
    for name in dead:
        params[f"{name}.bias"] -= np.float32(100.0)
    for shape in shapes:
        (picture, truth), close_calls = draw_without_close_calls(
            rng, lambda *pair: decisions_of_lpips(network, params, pair), shape, shape
        )
        inputs = {"picture": picture, "truth": truth}
        label = by(*shape) + "".join(f", {name} dead" for name in dead)
        yield Draw(
            label,
            inputs,
            {"network": network},
            params,
            tuple(inputs),
            module="lpips",
            on_gpu=ON_GPU_TOLERANCE,
            close_calls=close_calls,
        )


@case
def lpips_vgg(rng):
    """LPIPS with VGG on images of the smallest height that its poolings support."""
    yield from lpips_draws(rng, "lpips_vgg", [(2, 3, 16, 19)])


@case
def lpips_alex(rng):
    """LPIPS with AlexNet on the smallest images, on odd sizes, and with zero features, whose norm has no derivative."""
    yield from lpips_draws(rng, "lpips_alex", [(1, 3, 31, 31), (2, 3, 49, 36)])
    yield from lpips_draws(rng, "lpips_alex", [(1, 3, 47, 63)], dead=("conv5",))


@reference_for("lpips")
def lpips_reference(config, params, inputs):
    distance = reference.loss.lpips.lpips(config["network"], params, inputs["picture"], inputs["truth"])
    return {"distance": distance}


@case
def vgg19(rng):
    """The VGG-19 loss on the smallest images that its poolings support, and on odd sizes."""
    params = draw.vgg19_parameters(rng)
    for shape in [(1, 3, 16, 16), (1, 3, 19, 17)]:
        (picture, truth), close_calls = draw_without_close_calls(
            rng, lambda *pair: decisions_of_vgg19(params, [pair]), shape, shape
        )
        inputs = {"picture": picture, "truth": truth}
        yield Draw(by(*shape), inputs, {}, params, ("picture",), close_calls=close_calls)


@reference_for("vgg19")
def vgg19_reference(config, params, inputs):
    return {"loss": reference.loss.vgg19.vgg19(params, inputs["picture"], inputs["truth"])}


@case
def perceptual(rng):
    """Two sets of renders of the same targets, with one target and with several.

    The network's weights are inputs that take no gradient.
    """
    of_vgg = draw.vgg19_parameters(rng)
    (rendered, truth), close_calls = draw_without_close_calls(
        rng,
        lambda rendered, truth: decisions_of_vgg19(of_vgg, [(half, truth) for half in np.split(rendered, 2)]),
        (2, 2, 3, 16, 16),
        (1, 2, 3, 16, 16),
    )
    inputs = {"rendered": rendered, "truth": truth, **of_vgg}
    yield Draw("vgg19", inputs, {"kind": "vgg19"}, differentiate=("rendered",), close_calls=close_calls)
    of_alex = draw.lpips_parameters(rng, "lpips_alex")

    def decisions_of_alex(rendered, truth):
        both = [pictures for half in np.split(rendered, 2) for pictures in (half, truth)]
        return decisions_of_lpips("lpips_alex", of_alex, [pictures.reshape(-1, 3, 31, 31) for pictures in both])

    (rendered, truth), close_calls = draw_without_close_calls(
        rng, decisions_of_alex, (2, 1, 3, 31, 31), (1, 1, 3, 31, 31)
    )
    inputs = {"rendered": rendered, "truth": truth, **of_alex}
    yield Draw("lpips_alex", inputs, {"kind": "lpips_alex"}, differentiate=("rendered",), close_calls=close_calls)


@reference_for("perceptual")
def perceptual_reference(config, params, inputs):
    halves = inputs["rendered"].chunk(2)
    if config["kind"] == "vgg19":
        losses = [reference.loss.vgg19.vgg19(inputs, half, inputs["truth"]) for half in halves]
    else:
        *halves, truth = (t.flatten(0, 1) for t in (*halves, inputs["truth"]))
        losses = [reference.loss.lpips.lpips(config["kind"], inputs, half, truth).mean() for half in halves]
    return {"loss": sum(losses) / 2.0}
