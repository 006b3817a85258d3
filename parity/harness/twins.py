"""The reference under the names of the exchange: TWINS[module](config, params, inputs) -> outputs, all torch tensors.

`config` has the program's keys and parameters have the published names relative to the module, as in a request.
"""

import reference.decoder
import reference.encoder
import reference.jitter
import reference.loss.consistency
import reference.loss.decoder_regularization
import reference.loss.frustum
import reference.loss.lpips
import reference.loss.vgg19
import reference.loss.mse
import reference.loss.subsets
import reference.model
import reference.normalize
import reference.rays
import reference.resample
import reference.rotation
import reference.schedule
import reference.splat
import reference.stream
import reference.tokens
import torch

TWINS = {}

# The program's word: the reference's, which is that of the published configurations.
CONFIG_NAMES = {
    "patch_size": "patch_size",
    "latents": "latent_rep_token_amount",
    "width": "dim_latents",
    "rgb_width": "dim_rgb_feat",
    "ray_width": "dim_rays",
    "rounds": "rounds",
    "self_attention_blocks": "slot_calib_layers_per_round",
    "heads": "num_heads",
    "candidates": "M_max",
    "sh_degree": "sh_degree",
    "streams": "streams",
    "camera_code": "camera_code",
}
REGISTERS = 4
# The constant of the decoder, which is no parameter: both sides have their own.
MEAN_OFFSET = (0.0, 0.0, 1.5)


def twin(function):
    TWINS[function.__name__] = function
    return function


def reference_config(config):
    return {theirs: config[ours] for ours, theirs in CONFIG_NAMES.items()}


def under(prefix, params):
    return {f"{prefix}.{name}": value for name, value in params.items()}


# ---- tokens ----------------------------------------------------------------------------------------------------------


@twin
def patchify(config, params, inputs):
    return {"tokens": reference.tokens.patchify(inputs["xs"].movedim(-1, 2), config["patch_size"])}


@twin
def rgb_tokens(config, params, inputs):
    return {"tokens": reference.tokens.rgb_tokens(params, inputs["images"], config["patch_size"])}


@twin
def ray_tokens(config, params, inputs):
    tokens = reference.tokens.ray_tokens(
        params, inputs["c2w"], inputs["intrinsics"], *config["image"], config["patch_size"], config["camera_code"]
    )
    return {"tokens": tokens}


@twin
def rays(config, params, inputs):
    rays = reference.rays.plucker_rays(inputs["c2w"], inputs["intrinsics"], *config["image"])
    return {"rays": rays.movedim(2, -1)}


@twin
def camera_code(config, params, inputs):
    params = under("view_pe", params)
    return {"code": reference.rays.camera_code(params, inputs["c2w"], inputs["intrinsics"], *config["image"])}


@twin
def tokens(config, params, inputs):
    tokens = reference.tokens.view_tokens(
        reference_config(config), params, inputs["images"], inputs["c2w"], inputs["intrinsics"]
    )
    return {"tokens": tokens}


# ---- encoder ---------------------------------------------------------------------------------------------------------


@twin
def stream_round(config, params, inputs):
    slots, memory = inputs["slots"], inputs["memory"]
    mask = torch.ones(slots.shape[1], 1, dtype=slots.dtype)
    mask[-REGISTERS:] = 0.0
    heads, blocks = config["heads"], config["self_attention_blocks"]
    return {"slots": reference.stream.stream_round(under("round", params), "round", slots, memory, heads, blocks, mask)}


@twin
def self_attention_block(config, params, inputs):
    params = under("block", params)
    return {"slots": reference.stream.self_attention_block(params, "block", inputs["slots"], config["heads"])}


@twin
def mixer(config, params, inputs):
    params = under("mixer", params)
    geometry, appearance = reference.encoder.mixer(params, "mixer", inputs["geometry"], inputs["appearance"])
    return {"geometry": geometry, "appearance": appearance}


@twin
def encoder(config, params, inputs):
    tokens = inputs["tokens"][:, None]  # as of one view: the encoder doesn't tell views apart
    geometry, appearance = reference.encoder.encode(reference_config(config), params, tokens)
    return {"geometry": geometry, "appearance": appearance}


# ---- decoder ---------------------------------------------------------------------------------------------------------


def decoder_params(params, like):
    offset = torch.tensor(MEAN_OFFSET, dtype=like.dtype).reshape(1, 1, 3)
    return params | {"gaussian_decoder.patch_center_bias": offset}


@twin
def heads(config, params, inputs):
    params = under("gaussian_decoder", params)
    raw = reference.decoder.heads(reference_config(config), params, inputs["geometry"], inputs["appearance"])
    return {
        "positions": raw["position"],
        "log_scales": raw["log_scale"] + reference.decoder.LOG_SCALE_OFFSET,
        "rotations": raw["rotation"],
        "opacity_logits": raw["opacity"],
        "gate": raw["gate"],
        "sh": raw["sh"].flatten(-2),
    }


MERGED = {
    "position": "positions",
    "log_scale": "log_scales",
    "rotation": "rotations",
    "opacity": "opacity_logits",
    "sh": "sh",
}


@twin
def merge(config, params, inputs):
    full = {theirs: inputs[ours] for theirs, ours in MERGED.items()}
    merged = reference.decoder.merge_with_transition(full, inputs["gate"], config["stage"], config["mix"])
    return {MERGED[name]: value for name, value in merged.items()}


def gaussians(decoded):
    return {
        "means": decoded["means"],
        "scales": decoded["scales"],
        "rotations_6d": decoded["rotations_6d"],
        "quaternions": decoded["quats_wxyz"],
        "opacities": decoded["opacities"].squeeze(-1),
        "sh": decoded["sh"],
    }


@twin
def decoder(config, params, inputs):
    geometry, appearance = inputs["geometry"], inputs["appearance"]
    params = decoder_params(under("gaussian_decoder", params), geometry)
    decoded = reference.decoder.decode(
        reference_config(config), params, geometry, appearance, config["stage"], config["mix"]
    )
    return gaussians(decoded)


@twin
def rotation_matrix(config, params, inputs):
    return {"matrix": reference.rotation.matrix_from_6d(inputs["rotations"])}


@twin
def quaternion(config, params, inputs):
    matrix = reference.rotation.matrix_from_6d(inputs["rotations"])
    return {"quaternion": reference.rotation.quaternion_from_matrix(matrix)}


@twin
def model(config, params, inputs):
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


# ---- scene and pictures ----------------------------------------------------------------------------------------------


@twin
def scene_normalization(config, params, inputs):
    c2w, _, scale = reference.normalize.normalize_scene(inputs["c2w"])
    return {"c2w": c2w, "scale": scale}


def of_every_camera(inputs, function):
    """function(Gaussians of a scene, w2c, intrinsics) -> dict; the dicts' values stacked to [B, C, ...]."""
    rows = []
    for b in range(inputs["w2c"].shape[0]):
        scene = [inputs[name][b] for name in ("means", "scales", "quaternions", "opacities", "sh")]
        cameras = zip(inputs["w2c"][b], inputs["intrinsics"][b])
        rows.append([function(*scene, w2c, intrinsics) for w2c, intrinsics in cameras])
    return {key: torch.stack([torch.stack([seen[key] for seen in row]) for row in rows]) for key in rows[0][0]}


@twin
def projection(config, params, inputs):
    size = config["width"], config["height"], config["eps2d"]

    def project(means, scales, quaternions, opacities, sh, w2c, intrinsics):
        seen = reference.splat.project(means, scales, quaternions, w2c, intrinsics, *size)
        visible = seen["visible"] & (opacities >= reference.splat.SMALLEST_ALPHA)
        colour = reference.splat.sh_colour(means, sh, w2c)
        return {
            "visible": visible.long(),
            "mean2d": torch.where(visible[:, None], seen["mean2d"], 0.0),
            "conic": torch.where(visible[:, None], seen["conic"], 0.0),
            "depth": torch.where(visible, seen["depth"], 0.0),
            "colour": torch.where(visible[:, None], colour, 0.0),
        }

    return of_every_camera(inputs, project)


@twin
def rasterizer(config, params, inputs):
    def render(*scene_and_camera):
        rgb, alpha, depth = reference.splat.render(
            *scene_and_camera, config["width"], config["height"], config["eps2d"]
        )
        return {"rgb": rgb.movedim(-1, 0), "alpha": alpha, "depth": depth}

    return of_every_camera(inputs, render)


# ---- losses ----------------------------------------------------------------------------------------------------------


@twin
def mse(config, params, inputs):
    return {"loss": reference.loss.mse.mse(inputs["rendered"], inputs["truth"])}


@twin
def frustum(config, params, inputs):
    loss = reference.loss.frustum.frustum(
        inputs["means"], inputs["w2c"], inputs["intrinsics"], *config["image"], inputs["far"]
    )
    return {"loss": loss}


@twin
def sh_soft_cap(config, params, inputs):
    return {"loss": reference.loss.decoder_regularization.sh_soft_cap(inputs["sh"])}


@twin
def decoder_regularization(config, params, inputs):
    raw = {
        "log_scale": inputs["log_scales"],
        "rotation": inputs["rotations"],
        "sh": inputs["sh"],
        "opacity_logit": inputs["opacity_logits"],
    }
    return {"loss": reference.loss.decoder_regularization.decoder_regularization(raw, config["opacity"])}


@twin
def consistency(config, params, inputs):
    loss = reference.loss.consistency.consistency(
        inputs["alpha_a"],
        inputs["alpha_b"],
        inputs["depth_a"],
        inputs["depth_b"],
        config["alpha_factor"],
        config["depth_factor"],
    )
    return {"loss": loss}


@twin
def lpips(config, params, inputs):
    distance = reference.loss.lpips.lpips(config["network"], params, inputs["picture"], inputs["truth"])
    return {"distance": distance}


@twin
def vgg19(config, params, inputs):
    return {"loss": reference.loss.vgg19.vgg19(params, inputs["picture"], inputs["truth"])}


@twin
def perceptual(config, params, inputs):
    halves = inputs["rendered"].chunk(2)
    if config["kind"] == "vgg19":
        losses = [reference.loss.vgg19.vgg19(inputs, half, inputs["truth"]) for half in halves]
    else:
        *halves, truth = (t.flatten(0, 1) for t in (*halves, inputs["truth"]))
        losses = [reference.loss.lpips.lpips(config["kind"], inputs, half, truth).mean() for half in halves]
    return {"loss": sum(losses) / 2.0}


# ---- photos ----------------------------------------------------------------------------------------------------------


@twin
def resample(config, params, inputs):
    height, width = config["size"]
    return {"image": reference.resample.resample(inputs["image"], config["region"], height, width)}


@twin
def jitter(config, params, inputs):
    adjustments = [next(iter(adjustment.items())) for adjustment in config["adjustments"]]
    return {"image": reference.jitter.jitter(inputs["image"], adjustments)}


# ---- training --------------------------------------------------------------------------------------------------------


@twin
def subsets(config, params, inputs):
    a, b = reference.loss.subsets.subsets(list(range(config["views"])), config["step"])
    return {"a": torch.tensor(a), "b": torch.tensor(b)}


@twin
def learning_rate(config, params, inputs):
    rates = [
        reference.schedule.learning_rate(step, config["total"], config["peak"], config["warmup"])
        for step in inputs["steps"].tolist()
    ]
    return {"learning_rate": torch.tensor(rates, dtype=torch.float64)}


@twin
def stages(config, params, inputs):
    def at(step):
        if config["full_capacity"]:
            return config["final_stage"], 1.0
        return reference.schedule.stage(step, config["final_stage"], config["boundaries"], config["transition"])

    index, mix = zip(*(at(step) for step in inputs["steps"].tolist()))
    return {"index": torch.tensor(index), "mix": torch.tensor(mix, dtype=torch.float64)}


@twin
def adamw(config, params, inputs):
    # "token" stands for a learnable token of the model, which is told by its name.
    published = {"token": "scene_tokens"}
    after = {}
    for name, value in params.items():
        decays = reference.schedule.is_decayed(published.get(name, name), value)
        decay = config["weight_decay"] if decays else 0.0
        first = second = torch.zeros_like(value)
        for count, gradient in enumerate(inputs[f"grad.{name}"], start=1):
            value, first, second = reference.schedule.adamw_step(
                value, gradient, first, second, count, config["learning_rate"], decay
            )
        after[name] = value
    return after
