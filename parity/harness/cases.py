"""The cases: for each, random draws of configuration, parameters and inputs.

A case is a generator of draws. Its name is the function's; the program is asked for `module`, by default the same name.
"""

from dataclasses import dataclass, field
from itertools import product

import numpy as np

from . import draw, scenes
from .compare import FLOAT32, FLOAT64, Tolerance
from .draw import normal, uniform, whole
from .thresholds import closest_call, closest_call_of_vgg19, doubtful_pixels

CASES = {}

PROJECTION_THIN_FLOAT32 = Tolerance(
    1e-5,
    2e-3,
    why="the gradients of a Gaussian hundreds of times longer than wide are small differences of large terms; "
    "7e-4 measured, about as much as by the reference in float32",
)
RASTERIZER_FLOAT32 = Tolerance(
    1e-5,
    3e-4,
    pictures=1e-4,
    why="a gradient sums terms of both signs over all pixels of a Gaussian, and 1 - T has few digits where little is "
    "covered; 2.4e-4 is the largest over 8 seeds",
)
RESAMPLE = Tolerance(
    3e-4,
    0.0,
    why="rounded to levels, and what lies between two may become either: 3e-4 is one level in one of seven hundred values",
)
# Relative distance from a threshold within which rounding may decide.
DOUBT = {np.float64: 1e-9, np.float32: 5e-4}
MOST_TRIES = 100
# Of a layer's standard deviation, within which a ReLU or a max pooling may decide otherwise: twice what rounding moves
# numbers by.
CLOSE_CALL = 5e-6


@dataclass
class Draw:
    """One question. `label` tells it from the others of its case."""

    label: str
    inputs: dict = field(default_factory=dict)
    config: dict = field(default_factory=dict)
    params: dict = field(default_factory=dict)
    differentiate: tuple = ()
    module: str = ""
    tolerance: Tolerance = FLOAT32
    gradients: bool = True
    large: bool = False  # the reference computes in float32, on more than one core
    doubtful: np.ndarray | None = None  # pixels on a threshold, [B, C, H, W]

    def __post_init__(self):
        self.gradients = self.gradients and bool(self.params or self.differentiate)


def case(function):
    CASES[function.__name__] = function
    return function


def by(*sizes):
    """A shape as text."""
    return "×".join(map(str, sizes))


# ---- tokens ----------------------------------------------------------------------------------------------------------


@case
def patchify(rng):
    for shape, patch in [((1, 1, 4, 4, 3), 2), ((2, 3, 6, 15, 6), 3), ((1, 2, 5, 3, 2), 1)]:
        label = f"{by(*shape)}, patch {patch}"
        yield Draw(label, {"xs": normal(rng, *shape)}, {"patch_size": patch}, differentiate=("xs",))


def pictures(rng, config, batch, count):
    """(image height, width) in whole patches, and images with cameras."""
    patch = config["patch_size"]
    rows = whole(rng, 1, 4)
    height, width = patch * rows, patch * (rows + whole(rng, 1, 3))
    if rng.random() < 0.5:
        height, width = width, height
    images = uniform(rng, 0.0, 1.0, batch, count, 3, height, width)
    return (height, width), {"images": images} | draw.views(rng, batch, count, height, width)


@case
def rgb_tokens(rng):
    for _ in range(3):
        config = draw.model_config(rng)
        image, inputs = pictures(rng, config, whole(rng, 1, 3), whole(rng, 1, 4))
        images = {"images": inputs["images"]}
        params = {"rgb_patch_embeds.1.weight": draw.parameters(rng, config)["rgb_patch_embeds.1.weight"]}
        label = f"{by(*images['images'].shape)}, patch {config['patch_size']}"
        yield Draw(label, images, config, params, ("images",))


@case
def ray_tokens(rng):
    for code in (True, True, False):
        config = draw.model_config(rng, camera_code=code)
        image, inputs = pictures(rng, config, whole(rng, 1, 3), whole(rng, 1, 4))
        inputs.pop("images")
        params = draw.parameters(rng, config)
        params = {name: value for name, value in params.items() if name.startswith(("ray_patch_embeds", "view_pe"))}
        label = f"{by(*inputs['c2w'].shape[:2], *image)}, {'camera code' if code else 'no camera code'}"
        yield Draw(label, inputs, config | {"image": image}, params)


@case
def rays(rng):
    for batch, count, image in [(1, 1, (1, 1)), (2, 3, (7, 12)), (1, 4, (33, 17))]:
        yield Draw(by(batch, count, *image), draw.views(rng, batch, count, *image), {"image": image})


@case
def camera_code(rng):
    for batch, count, image in [(1, 1, (8, 8)), (2, 5, (24, 40)), (3, 2, (256, 256))]:
        config = draw.model_config(rng)
        params = draw.parameters(rng, config, "view_pe.")
        inputs = draw.views(rng, batch, count, *image)
        yield Draw(f"{by(batch, count)}, image {by(*image)}", inputs, config | {"image": image}, params)


@case
def tokens(rng):
    for code in (True, True, False):
        config = draw.model_config(rng, camera_code=code)
        image, inputs = pictures(rng, config, whole(rng, 1, 3), whole(rng, 1, 4))
        params = draw.parameters(rng, config)
        tokenizer = ("rgb_patch_embeds", "ray_patch_embeds", "view_pe")
        params = {name: value for name, value in params.items() if name.startswith(tokenizer)}
        label = f"{by(*inputs['images'].shape)}, {'camera code' if code else 'no camera code'}"
        yield Draw(label, inputs, config, params, ("images",))


# ---- encoder ---------------------------------------------------------------------------------------------------------


@case
def stream_round(rng):
    for _ in range(3):
        config = draw.model_config(rng)
        batch, slots, memory = whole(rng, 1, 3), whole(rng, 6, 15), whole(rng, 5, 30)
        inputs = {
            "slots": normal(rng, batch, slots, config["width"]),
            "memory": normal(rng, batch, memory, config["ray_width"] + config["rgb_width"]),
        }
        params = draw.parameters(rng, config, "slot_encoder.geo_rounds.0.")
        label = f"{by(*inputs['slots'].shape)}, memory {by(*inputs['memory'].shape)}, heads {config['heads']}"
        yield Draw(label, inputs, config, params, ("slots", "memory"))


@case
def self_attention_block(rng):
    for _ in range(3):
        config = draw.model_config(rng)
        slots = normal(rng, whole(rng, 1, 3), whole(rng, 1, 15), config["width"])
        params = draw.parameters(rng, config, "slot_encoder.geo_rounds.0.tower.0.")
        yield Draw(f"{by(*slots.shape)}, heads {config['heads']}", {"slots": slots}, config, params, ("slots",))


@case
def mixer(rng):
    for _ in range(3):
        config = draw.model_config(rng)
        shape = whole(rng, 1, 3), whole(rng, 1, 15), config["width"]
        inputs = {"geometry": normal(rng, *shape), "appearance": normal(rng, *shape)}
        params = draw.parameters(rng, config, "slot_encoder.pair_adapters.0.")
        yield Draw(by(*shape), inputs, config, params, ("geometry", "appearance"))


@case
def encoder(rng):
    for streams in ("dual", "dual", "single"):
        config = draw.model_config(rng, streams=streams)
        shape = whole(rng, 1, 3), whole(rng, 4, 40), config["ray_width"] + config["rgb_width"]
        params = draw.parameters(rng, config)
        params = {name: value for name, value in params.items() if name.startswith(("scene_tokens", "slot_encoder"))}
        label = f"{by(*shape)}, slots {by(config['latents'], config['width'])}, rounds {config['rounds']}, {streams}"
        yield Draw(label, {"tokens": normal(rng, *shape)}, config, params, ("tokens",))


# ---- decoder ---------------------------------------------------------------------------------------------------------


def latents(rng, config, batch):
    shape = batch, config["latents"], config["width"]
    return {"geometry": normal(rng, *shape), "appearance": normal(rng, *shape)}


@case
def heads(rng):
    for degree in range(4):
        config = draw.model_config(rng, sh_degree=degree)
        inputs = latents(rng, config, whole(rng, 1, 3))
        params = draw.parameters(rng, config, "gaussian_decoder.")
        label = f"{by(*inputs['geometry'].shape)}, K {config['candidates']}, degree {degree}"
        yield Draw(label, inputs, config, params, ("geometry", "appearance"))


def stages_of(candidates):
    """Every stage, before, in and after its transition."""
    return product(range(int(np.log2(candidates)) + 1), (0.0, 0.3, 1.0))


@case
def merge(rng):
    for candidates in (2, 16):
        for stage, mix in stages_of(candidates):
            shape = whole(rng, 1, 2), whole(rng, 3, 9), candidates
            inputs = {
                "positions": normal(rng, *shape, 3),
                "log_scales": uniform(rng, -10.2, -1.0, *shape, 3),
                "rotations": normal(rng, *shape, 6),
                "opacity_logits": uniform(rng, -13.0, 6.0, *shape, 1),
                "sh": normal(rng, *shape, 3 * whole(rng, 1, 4) ** 2),
                "gate": normal(rng, *shape),
            }
            label = f"{by(*shape)}, stage {stage}, λ {mix}"
            yield Draw(label, inputs, {"stage": stage, "mix": mix}, differentiate=tuple(inputs))


@case
def decoder(rng):
    for candidates in (2, 16):
        for stage, mix in stages_of(candidates):
            config = draw.model_config(rng, candidates=candidates)
            inputs = latents(rng, config, whole(rng, 1, 2))
            params = draw.parameters(rng, config, "gaussian_decoder.")
            label = f"{by(*inputs['geometry'].shape)}, K {candidates}, stage {stage}, λ {mix}"
            config |= {"stage": stage, "mix": mix}
            yield Draw(label, inputs, config, params, ("geometry", "appearance"))


def rotations(rng):
    """Random ones, the identity, and half turns, whose quaternion has no real part."""
    yield normal(rng, 3, 17, 6)
    yield normal(rng, 50, 6)
    yield normal(rng, 2, 2, 5, 6, scale=0.1) + np.float32([1, 0, 0, 0, 1, 0])
    turns = [[1, 0, 0, 0, 1, 0], [1, 0, 0, 0, -1, 0], [-1, 0, 0, 0, 1, 0], [-1, 0, 0, 0, -1, 0]]
    yield np.float32(turns) * np.float32([[0.5], [1], [2], [3]])


@case
def rotation_matrix(rng):
    for six in rotations(rng):
        yield Draw(by(*six.shape), {"rotations": six}, differentiate=("rotations",))


@case
def quaternion(rng):
    for six in rotations(rng):
        yield Draw(by(*six.shape), {"rotations": six}, differentiate=("rotations",))


# ---- scene and pictures ----------------------------------------------------------------------------------------------


@case
def scene_normalization(rng):
    for count in (1, 2, 7, 36):
        c2w = draw.poses(rng, count, turn=0.4, move=whole(rng, 1, 20))
        yield Draw(f"{count} cameras", {"c2w": c2w}, tolerance=FLOAT64)
    together = draw.poses(rng, 3)
    together[:, :3, 3] = together[0, :3, 3]
    yield Draw("3 cameras in one place", {"c2w": together}, tolerance=FLOAT64)


def splat_draws(rng, module, dtype, family, tolerance):
    """Float64 scenes are drawn again until none of their pixels is doubtful. Float32 ones say which pixels are, and
    these have no gradient."""
    differentiate = ("means", "scales", "quaternions", "sh")
    if module == "rasterizer":
        differentiate += ("opacities",)
    for label, (size, make) in family.items():
        config = scenes.settings(size)
        for _ in range(MOST_TRIES):
            inputs = {name: value.astype(dtype) for name, value in make(rng, size).items()}
            doubtful = doubtful_pixels(config, inputs, DOUBT[dtype]) if module == "rasterizer" else None
            if doubtful is None or dtype == np.float32 or not doubtful.any():
                break
        else:
            raise RuntimeError(f"{label}: every one of {MOST_TRIES} scenes has a pixel on a threshold")
        yield Draw(
            label, inputs, config, differentiate=differentiate, module=module, tolerance=tolerance, doubtful=doubtful
        )


@case
def projection(rng):
    family = scenes.RANDOM | scenes.ADVERSARIAL | scenes.THIN
    yield from splat_draws(rng, "projection", np.float64, family, FLOAT64)


@case
def projection_float32(rng):
    yield from splat_draws(rng, "projection", np.float32, scenes.RANDOM | scenes.ADVERSARIAL, FLOAT32)


@case
def projection_thin_float32(rng):
    yield from splat_draws(rng, "projection", np.float32, scenes.THIN, PROJECTION_THIN_FLOAT32)


@case
def rasterizer(rng):
    yield from splat_draws(rng, "rasterizer", np.float64, scenes.RANDOM, FLOAT64)


@case
def rasterizer_adversarial(rng):
    yield from splat_draws(rng, "rasterizer", np.float64, scenes.ADVERSARIAL | scenes.THIN, FLOAT64)


@case
def rasterizer_float32(rng):
    yield from splat_draws(rng, "rasterizer", np.float32, scenes.RANDOM, RASTERIZER_FLOAT32)


@case
def rasterizer_adversarial_float32(rng):
    yield from splat_draws(rng, "rasterizer", np.float32, scenes.ADVERSARIAL, RASTERIZER_FLOAT32)


@case
def rasterizer_thin_float32(rng):
    yield from splat_draws(rng, "rasterizer", np.float32, scenes.THIN, RASTERIZER_FLOAT32)


# ---- losses ----------------------------------------------------------------------------------------------------------


@case
def mse(rng):
    for shape in [(1, 1, 3, 1, 1), (2, 3, 3, 7, 12)]:
        images = {"rendered": uniform(rng, 0.0, 1.0, *shape), "truth": uniform(rng, 0.0, 1.0, *shape)}
        yield Draw(by(*shape), images, differentiate=("rendered",))


@case
def frustum(rng):
    """Points around the cameras, none within 0.05 of a camera's plane, where pixel coordinates have no digits."""
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


@case
def sh_soft_cap(rng):
    for shape in [(1, 1, 1, 3), (2, 5, 4, 27)]:
        yield Draw(by(*shape), {"sh": normal(rng, *shape, scale=5.0)}, differentiate=("sh",))


@case
def decoder_regularization(rng):
    for opacity in (True, False):
        shape = whole(rng, 1, 3), whole(rng, 2, 9), whole(rng, 1, 16)
        inputs = {
            "log_scales": normal(rng, *shape, 3, scale=3.0, mean=-3.0),
            "rotations": normal(rng, *shape, 6),
            "sh": normal(rng, *shape, 27, scale=5.0),
            "opacity_logits": uniform(rng, -13.0, 6.0, *shape, 1),
        }
        label = f"{by(*shape)}, {'with' if opacity else 'without'} opacity"
        yield Draw(label, inputs, {"opacity": opacity}, differentiate=tuple(inputs))


@case
def consistency(rng):
    """A fifth of the pixels below the opacity at which depth counts; once all of them."""
    for shape, empty, factors in [
        ((1, 1, 4, 4), 0.2, (1e-3, 1e-2)),
        ((2, 3, 7, 12), 0.2, (1.0, 0.5)),
        ((1, 2, 3, 5), 1.0, (1.0, 1.0)),
    ]:

        def alpha():
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


def sure_pictures(rng, closest, *shapes):
    """Random pictures of these shapes, drawn until no threshold is a close call."""
    for _ in range(MOST_TRIES):
        pictures = [uniform(rng, 0.0, 1.0, *shape) for shape in shapes]
        if closest(*pictures) > CLOSE_CALL:
            return pictures
    raise RuntimeError(f"every one of {MOST_TRIES} sets of pictures has a close call")


def lpips_draws(rng, network, shapes, dead=()):
    """Pictures are drawn again until no ReLU and no pooling is a close call. The layers in `dead` put out nothing."""
    params = draw.lpips_parameters(rng, network)
    for name in dead:
        params[f"{name}.bias"] -= np.float32(100.0)
    for shape in shapes:
        picture, truth = sure_pictures(
            rng, lambda *pair: closest_call(network, params, np.concatenate(pair)), shape, shape
        )
        inputs = {"picture": picture, "truth": truth}
        label = by(*shape) + "".join(f", {name} dead" for name in dead)
        yield Draw(label, inputs, {"network": network}, params, tuple(inputs), module="lpips")


@case
def lpips_vgg(rng):
    yield from lpips_draws(rng, "lpips_vgg", [(2, 3, 16, 19)])


@case
def lpips_alex(rng):
    yield from lpips_draws(rng, "lpips_alex", [(1, 3, 31, 31), (2, 3, 49, 36)])
    yield from lpips_draws(rng, "lpips_alex", [(1, 3, 47, 63)], dead=("conv5",))


@case
def vgg19(rng):
    params = draw.vgg19_parameters(rng)
    for shape in [(1, 3, 16, 16), (1, 3, 19, 17)]:
        picture, truth = sure_pictures(rng, lambda *pair: closest_call_of_vgg19(params, *pair), shape, shape)
        yield Draw(by(*shape), {"picture": picture, "truth": truth}, {}, params, ("picture",))


@case
def perceptual(rng):
    """Two renderings of the same targets. The network's weights are inputs that take no gradient."""
    params = draw.vgg19_parameters(rng)

    def closest_to_vgg19(rendered, truth):
        return min(closest_call_of_vgg19(params, half, truth[0]) for half in rendered)

    rendered, truth = sure_pictures(rng, closest_to_vgg19, (2, 1, 3, 16, 16), (1, 1, 3, 16, 16))
    inputs = {"rendered": rendered, "truth": truth, **params}
    yield Draw("vgg19", inputs, {"kind": "vgg19"}, differentiate=("rendered",))
    params = draw.lpips_parameters(rng, "lpips_alex")
    rendered, truth = sure_pictures(
        rng,
        lambda *both: closest_call("lpips_alex", params, np.concatenate(both).reshape(-1, 3, 31, 31)),
        (2, 1, 3, 31, 31),
        (1, 1, 3, 31, 31),
    )
    inputs = {"rendered": rendered, "truth": truth, **params}
    yield Draw("lpips_alex", inputs, {"kind": "lpips_alex"}, differentiate=("rendered",))


# ---- photos ----------------------------------------------------------------------------------------------------------


@case
def resample(rng):
    """Smooth photos, and saturated ones, in which filters ring out of range."""
    for shape, region, size in [
        ((45, 80), (0, 0, 80, 45), (32, 57)),
        ((45, 80), (20.3, 1.7, 40.2, 41.9), (31, 29)),
        ((30, 21), (0, 0, 21, 30), (50, 33)),
        ((90, 70), (35.5, 44.5, 30.25, 40), (8, 6)),
    ]:
        for saturated in (False, True):
            image = rng.integers(0, 256, (*shape, 3))
            image = np.where(image < 128, 0, 255) if saturated else image
            label = f"{by(*shape)} to {by(*size)}{', saturated' if saturated else ''}"
            config = {"region": region, "size": size}
            yield Draw(label, {"image": image.astype(np.uint8)}, config, tolerance=RESAMPLE)


@case
def jitter(rng):
    """Each adjustment by itself, and all of them in two orders; some pixels are grey, black or white."""
    one = [{"brightness": 1.3}, {"contrast": 0.6}, {"saturation": 1.4}, {"hue": -0.1}, {"hue": 0.45}]
    several = [{"hue": 0.1}, {"contrast": 1.4}, {"brightness": 0.7}, {"saturation": 0.7}]
    for adjustments in [*([adjustment] for adjustment in one), several, several[::-1]]:
        image = uniform(rng, 0.0, 1.0, 3, 13, 22)
        image[:, 0] = image[:1, 0]
        image[:, 1, :11], image[:, 1, 11:] = 0.0, 1.0
        names = ", ".join(next(iter(adjustment)) for adjustment in adjustments)
        yield Draw(names, {"image": image}, {"adjustments": adjustments})


# ---- training --------------------------------------------------------------------------------------------------------


@case
def subsets(rng):
    for views, step in product((2, 3, 7, 24), (0, 1)):
        yield Draw(f"{views} views, step {step}", config={"views": views, "step": step})


@case
def learning_rate(rng):
    for total, warmup, peak in [(220_000, 0.03, 5e-4), (1_000, 0.1, 2e-5), (500, 0.0, 1e-2)]:
        edges = [0, 1, int(warmup * total), int(warmup * total) + 1, total - 1, total, total + 10]
        steps = np.concatenate([edges, rng.integers(0, total, 50)]).astype(np.int64)
        config = {"peak": peak, "total": total, "warmup": warmup}
        yield Draw(f"{total} steps", {"steps": steps}, config, tolerance=FLOAT64)


@case
def stages(rng):
    for final, full in [(0, False), (1, False), (3, False), (3, True)]:
        edges = [0, 9_999, 10_000, 10_001, 11_999, 12_000, 19_999, 20_000, 49_999, 50_000, 52_000, 220_000]
        steps = np.concatenate([edges, rng.integers(0, 60_000, 50)]).astype(np.int64)
        config = {
            "final_stage": final,
            "boundaries": [10_000, 20_000, 50_000],
            "transition": 2_000,
            "full_capacity": full,
        }
        label = f"final stage {final}, full capacity" if full else f"final stage {final}"
        yield Draw(label, {"steps": steps}, config, tolerance=FLOAT64)


@case
def adamw(rng):
    for steps in (1, 12):
        params = {
            "layer.weight": normal(rng, 4, 7),
            "layer.bias": normal(rng, 4),
            "token": normal(rng, 1, 3, 5),
        }
        gradients = {f"grad.{name}": normal(rng, steps, *value.shape) for name, value in params.items()}
        config = {"learning_rate": 1e-2, "weight_decay": 0.3}
        yield Draw(f"{steps} steps", gradients, config, params, gradients=False)


# ---- the whole model -------------------------------------------------------------------------------------------------


@case
def model(rng):
    for stage, mix, fixed in [
        (0, 1.0, {}),
        (2, 0.3, {"candidates": 8, "sh_degree": 3}),
        (1, 1.0, {"streams": "single"}),
        (1, 0.0, {"camera_code": False}),
    ]:
        config = draw.model_config(rng, **fixed)
        image, inputs = pictures(rng, config, whole(rng, 1, 2), whole(rng, 1, 3))
        kind = "" if config["camera_code"] else ", no camera code"
        label = f"{by(*inputs['images'].shape)}, stage {stage}, λ {mix}, {config['streams']}{kind}"
        params = draw.parameters(rng, config)
        yield Draw(label, inputs, config | {"stage": stage, "mix": mix}, params, ("images",))


@case
def model_16k(rng):
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
