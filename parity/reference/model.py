"""The complete forward pass: posed views to Gaussians."""

from .decoder import decode
from .encoder import encode
from .tokens import view_tokens


def forward(config, params, images, c2w, intrinsics, stage, mix):
    """Runs the model on images [B, V, 3, H, W] in [0, 1], normalized c2w [B, V, 4, 4] and intrinsics [B, V, 3, 3] in
    pixels.

    `config` has the keys of the program's section `model`. `stage` s exposes 2^s Gaussians per token, `mix` is lambda in
    [0, 1]. Returns the dict of `decoder.decode`.
    """
    tokens = view_tokens(config, params, images, c2w, intrinsics)
    geometry, appearance = encode(config, params, tokens.flatten(1, 2))
    return decode(config, params, geometry, appearance, stage, mix)
