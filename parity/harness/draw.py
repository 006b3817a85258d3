"""Random parameters and inputs with shapes and magnitudes like those of the model."""

from typing import Any

import numpy as np
import torch

from ..reference.normalize import invert_rigid
from ..reference.perceptual import BLOCKS, COMPARED, NETWORKS
from ..reference.rotation import matrix_from_quaternion

AUXILIARIES = 4
# The paper's main model.
MAIN_16K: dict[str, Any] = {
    **{"patch_size": 8, "latents": 2048, "width": 512, "rgb_width": 512, "ray_width": 256, "rounds": 4},
    **{
        "self_attention_blocks": 2,
        "heads": 8,
        "candidates": 16,
        "sh_degree": 3,
        "streams": "dual",
        "camera_code": True,
    },
}


def integer(rng, low, high):
    """Returns a random integer from low to high, inclusive."""
    return int(rng.integers(low, high + 1))


def normal(rng, *shape, scale=1.0, mean=0.0):
    return (mean + scale * rng.standard_normal(shape)).astype(np.float32)


def uniform(rng, low, high, *shape):
    return rng.uniform(low, high, shape).astype(np.float32)


def model_config(rng, **fixed):
    """Returns the configuration of a random small model, with sizes that mostly differ from each other."""
    heads = integer(rng, 1, 4)
    config = {
        "patch_size": integer(rng, 2, 5),
        "latents": integer(rng, 3, 11),
        "width": heads * integer(rng, 4, 8),
        "rgb_width": integer(rng, 6, 20),
        "ray_width": integer(rng, 6, 20),
        "rounds": integer(rng, 1, 3),
        "self_attention_blocks": integer(rng, 1, 2),
        "heads": heads,
        "candidates": 2 ** integer(rng, 1, 4),
        "sh_degree": integer(rng, 0, 3),
        "streams": "dual",
        "camera_code": True,
    }
    return config | fixed


# ---- parameters ------------------------------------------------------------------------------------------------------


def shapes(config):
    """Returns the shapes of all trainable parameters of a model by name."""
    d, token = config["width"], config["ray_width"] + config["rgb_width"]
    k, bases, pixels = config["candidates"], (config["sh_degree"] + 1) ** 2, config["patch_size"] ** 2
    found: dict[str, tuple[int, ...]] = {}

    def linear(name, outputs, inputs, bias=True):
        found[f"{name}.weight"] = (outputs, inputs)
        if bias:
            found[f"{name}.bias"] = (outputs,)

    def norm(name, width):
        found[f"{name}.weight"] = found[f"{name}.bias"] = (width,)

    def scale(name):
        found[f"{name}.gamma"] = (d,)

    found["scene_tokens"] = (config["latents"], d)
    linear("rgb_patch_embeds.1", config["rgb_width"], 3 * pixels, bias=False)
    linear("ray_patch_embeds.1", config["ray_width"], 6 * pixels, bias=False)
    if config["camera_code"]:
        linear("view_pe.k_mlp.0", 64, 4)
        linear("view_pe.k_mlp.2", 64, 64)
        linear("view_pe.proj", config["ray_width"], 64 + 27)

    found["slot_encoder.scale_emb"] = (1, 1, d)
    found["slot_encoder.aux_query_tokens"] = found["slot_encoder.slot_regs"] = (1, AUXILIARIES, d)
    found["slot_encoder.mem_regs"] = (1, 4, token)
    dual = config["streams"] == "dual"
    for stream in ("geo", "tex") if dual else ("geo",):
        norm(f"slot_encoder.slot_to_{stream}.0", d)
        linear(f"slot_encoder.slot_to_{stream}.1", d, d)
        for i in range(config["rounds"]):
            name = f"slot_encoder.{stream}_rounds.{i}"
            norm(f"{name}.slots_ln", d)
            norm(f"{name}.mem_ln", token)
            norm(f"{name}.post_ln", d)
            linear(f"{name}.lat_q", d, d)
            linear(f"{name}.mem_k", d, token)
            linear(f"{name}.mem_v", d, token)
            linear(f"{name}.out_proj", d, d)
            scale(f"{name}.attn_ls")
            linear(f"{name}.mlp.0", 4 * d, d)
            linear(f"{name}.mlp.2", d, 4 * d)
            scale(f"{name}.mlp_ls")
            for j in range(config["self_attention_blocks"]):
                block = f"{name}.tower.{j}"
                norm(f"{block}.norm1", d)
                linear(f"{block}.attn.qkv", 3 * d, d)
                linear(f"{block}.attn.proj", d, d)
                scale(f"{block}.ls1")
                norm(f"{block}.norm2", d)
                linear(f"{block}.mlp.fc1", 4 * d, d)
                linear(f"{block}.mlp.fc2", d, 4 * d)
                scale(f"{block}.ls2")
    for i in range(config["rounds"]) if dual else ():
        name = f"slot_encoder.pair_adapters.{i}"
        norm(f"{name}.ln_g", d)
        norm(f"{name}.ln_t", d)
        linear(f"{name}.mlp.0", d, 2 * d)
        linear(f"{name}.mlp.2", 2 * d, d)
        scale(f"{name}.ls_g")
        scale(f"{name}.ls_t")

    linear("gaussian_decoder.geo_pos_readout", 3 * k, d)
    linear("gaussian_decoder.geo_param_readout", 10 * k, d)
    linear("gaussian_decoder.gate_readout", k, d)
    linear("gaussian_decoder.sh_readout", 3 * bases * k, d)
    return found


def parameters(rng, config, *prefixes):
    """Returns random parameters whose name begins with one of `prefixes`, by name.

    Weights have a standard deviation of 0.45 / sqrt(inputs), which for 512 inputs is the initial 0.02 of training.
    LayerScales are from 0.1 to 1, far above their initial value, so that every path matters. No value is exactly 0 or
    1. The decoder's biases put some of the candidates beyond each clamp.
    """
    drawn = {}
    for name, shape in shapes(config).items():
        if not name.startswith(prefixes or ""):
            continue
        if name.endswith(".gamma"):
            value = uniform(rng, 0.1, 1.0, *shape)
        elif name.endswith(".weight") and len(shape) == 1:
            value = normal(rng, *shape, scale=0.2, mean=1.0)
        elif name.endswith(".weight"):
            value = normal(rng, *shape, scale=0.45 / shape[1] ** 0.5)
        elif name == "gaussian_decoder.geo_param_readout.bias":
            kinds = [(3, 3.0, -2.0), (6, 0.5, 0.0), (1, 4.0, 4.0)]  # log-scales, rotations, opacity logits
            columns = [normal(rng, config["candidates"], n, scale=scale, mean=mean) for n, scale, mean in kinds]
            value = np.concatenate(columns, axis=1).flatten()
        else:  # biases and learnable tokens
            value = normal(rng, *shape, scale=0.3)
        drawn[name] = value
    return drawn


def lpips_parameters(rng, network):
    """Returns random parameters of an LPIPS network, scaled so that features neither vanish nor grow between layers."""
    drawn, inputs, compared = {}, 3, COMPARED[network]
    for name, outputs, kernel, _, _ in (layer for row in NETWORKS[network] for layer in row):
        scale = (2.0 / (inputs * kernel**2)) ** 0.5
        drawn[f"{name}.weight"] = normal(rng, outputs, inputs, kernel, kernel, scale=scale)
        drawn[f"{name}.bias"] = normal(rng, outputs, scale=0.1)
        if name in compared:
            drawn[f"lin{compared.index(name)}.weight"] = uniform(rng, 0.0, 1.0, 1, outputs, 1, 1)
        inputs = outputs
    return drawn


def vgg19_parameters(rng):
    """Returns random parameters of VGG-19, scaled so that features stay as large as the input, 0 to 255."""
    drawn, inputs = {}, 3
    for places, outputs in BLOCKS:
        for place in places:
            scale = (2.0 / (inputs * 9)) ** 0.5
            drawn[f"features.{place}.weight"] = normal(rng, outputs, inputs, 3, 3, scale=scale)
            drawn[f"features.{place}.bias"] = normal(rng, outputs, scale=5.0)
            inputs = outputs
    return drawn


# ---- cameras and images ----------------------------------------------------------------------------------------------


def poses(rng, *batch, turn=0.15, move=0.4):
    """Returns random camera-to-world matrices [*batch, 4, 4], float64, near the origin and looking roughly along z."""
    quaternion = np.array([1.0, 0.0, 0.0, 0.0]) + turn * rng.standard_normal((*batch, 4))
    pose = np.zeros((*batch, 4, 4))
    pose[..., :3, :3] = matrix_from_quaternion(torch.tensor(quaternion)).numpy()
    pose[..., :3, 3] = move * rng.standard_normal((*batch, 3))
    pose[..., 3, 3] = 1.0
    return pose


def ring(count, elevation):
    """Returns camera-to-world matrices [count, 4, 4], float64, of cameras that look at the origin.

    They are evenly spaced on a circle at distance 1 from the origin, elevated by the angle `elevation` in radians.
    """
    pose = np.zeros((count, 4, 4))
    for i, turn in enumerate(2 * np.pi * np.arange(count) / count):
        level, below = np.array([np.sin(turn), 0.0, np.cos(turn)]), np.array([0.0, 1.0, 0.0])
        down = np.cos(elevation) * below + np.sin(elevation) * level
        forward = np.cos(elevation) * level - np.sin(elevation) * below
        pose[i, :3, :3] = np.stack([np.cross(down, forward), down, forward], axis=-1)
        pose[i, :3, 3] = -forward
    pose[:, 3, 3] = 1.0
    return pose


def inverse(pose):
    return invert_rigid(torch.tensor(pose)).numpy()


def intrinsics(rng, *batch, height, width):
    """Returns random intrinsics [*batch, 3, 3] in pixels, float64."""
    k = np.zeros((*batch, 3, 3))
    k[..., 0, 0] = width * rng.uniform(0.7, 1.3, batch)
    k[..., 1, 1] = height * rng.uniform(0.7, 1.3, batch)
    k[..., 0, 2] = width * rng.uniform(0.4, 0.6, batch)
    k[..., 1, 2] = height * rng.uniform(0.4, 0.6, batch)
    k[..., 2, 2] = 1.0
    return k


def views(rng, batch, count, height, width):
    """Returns random c2w and intrinsics of B x V cameras, float32."""
    return {
        "c2w": poses(rng, batch, count).astype(np.float32),
        "intrinsics": intrinsics(rng, batch, count, height=height, width=width).astype(np.float32),
    }


def images(rng, config, batch, count):
    """Returns random images of one patch and more, whose sides are multiples of the patch size, with cameras."""
    patch = config["patch_size"]
    rows = integer(rng, 1, 4)
    height, width = patch * rows, patch * (rows + integer(rng, 0, 3))
    if rng.random() < 0.5:
        height, width = width, height
    images = uniform(rng, 0.0, 1.0, batch, count, 3, height, width)
    return {"images": images} | views(rng, batch, count, height, width)
