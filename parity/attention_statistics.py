"""Analyses the cross-attention of scene tokens to a capture's photos.

    python parity/attention_statistics.py --weights models/tiny.safetensors --capture DIR     DIR has a cameras.json

The model is the parity checks' reference. Keys and values are linear in the normalized image tokens. For each, the
table shows the contributions of the ray and colour channels: root mean square over patches and channels, after the mean
over patches is subtracted. It also shows how many patches a head attends to: e^entropy of its attention weights, as the
median over scene tokens, over all patches and within one view as if there were no other views.
"""

import argparse
import json
import tomllib
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from safetensors import safe_open

from parity import reference
from parity.harness import draw
from parity.reference.encoder import encode
from parity.reference.layers import layer_norm, linear
from parity.reference.names import reference_config
from parity.reference.normalize import normalize_scene
from parity.reference.tokens import view_tokens


def read_model(path):
    """Returns the weights in float32, and the configuration of the training run from their metadata."""
    with safe_open(path, "pt") as file:
        config = tomllib.loads(file.metadata()["globalsplat.config"])
        return {name: file.get_tensor(name).float() for name in file.keys()}, config  # noqa: SIM118


def read_capture(folder, height, width):
    """Reads a capture, resized to height × width.

    Returns images [1, V, 3, H, W], normalized c2w [1, V, 4, 4] and intrinsics [1, V, 3, 3] in pixels of these images.
    """
    described = json.loads((folder / "cameras.json").read_text())
    views = described["views"]
    photos = [Image.open(folder / view["image"]).convert("RGB").resize((width, height)) for view in views]
    images = torch.tensor(np.stack([np.asarray(photo) for photo in photos])).permute(0, 3, 1, 2) / 255.0
    c2w, _, _ = normalize_scene(torch.tensor([view["c2w"] for view in views]))
    intrinsics = torch.tensor([view["intrinsic"] for view in views])
    rows, columns = described["image_shape"]
    intrinsics = intrinsics * torch.tensor([width / columns, height / rows, 1.0])[:, None]
    return images[None], c2w[None], intrinsics[None]


def perplexity(weights):
    return torch.exp(torch.special.entr(weights).sum(-1))


def print_row(config, params, name, slots, memory, views):
    """Prints a row about the cross-attention of one round of one stream, given its inputs."""
    ray_width, heads = config["dim_rays"], config["num_heads"]
    normed = layer_norm(params, f"{name}.mem_ln", memory)[0, 4:]  # patches only, without the registers
    apart = normed - normed.mean(0)

    def contribution(layer, half):
        return (apart[:, half] @ params[f"{name}.{layer}.weight"][:, half].T).square().mean().sqrt().item()

    rays, colours = slice(0, ray_width), slice(ray_width, None)
    keys = linear(params, f"{name}.mem_k", normed).view(len(normed), heads, -1)
    queries = linear(params, f"{name}.lat_q", layer_norm(params, f"{name}.slots_ln", slots))[0]
    scene = slice(draw.AUXILIARIES, draw.AUXILIARIES + config["latent_rep_token_amount"])
    queries = queries[scene].view(-1, heads, keys.shape[-1])
    scores = torch.einsum("qhc,khc->hqk", queries, keys) / keys.shape[-1] ** 0.5
    patches = perplexity(scores.softmax(-1)).median().item()
    in_view = perplexity(scores.unflatten(-1, (views, -1)).softmax(-1)).median().item()
    contributions = [contribution(layer, half) for layer in ("mem_k", "mem_v") for half in (rays, colours)]
    numbers = [f"{number:>12.3f}" for number in contributions] + [f"{number:>12.1f}" for number in (patches, in_view)]
    print(f"{name.removeprefix('slot_encoder.'):<14} {' '.join(numbers)}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--capture", type=Path, required=True)
    options = parser.parse_args()
    params, run = read_model(options.weights)
    config = reference_config(draw.MAIN_16K | run["model"])
    inputs = read_capture(options.capture, *run["data"]["image_size"])
    tokens = view_tokens(config, params, *inputs)
    halves = tokens.split([config["dim_rays"], config["dim_rgb_feat"]], -1)
    rays, colours = (half.norm(dim=-1).mean().item() for half in halves)
    print(f"image tokens: rays, with the camera code, are {rays:.0f} long, colours {colours:.0f}")
    columns = ["keys, rays", "colours", "values, rays", "colours", "patches", "in a view"]
    print(f"{'':<14} {' '.join(f'{column:>12}' for column in columns)}")

    read = reference.stream.read_memory

    def looked_at(params, name, slots, memory, *others):
        print_row(config, params, name, slots, memory, inputs[0].shape[1])
        return read(params, name, slots, memory, *others)

    reference.stream.read_memory = looked_at
    encode(config, params, tokens)


if __name__ == "__main__":
    main()
