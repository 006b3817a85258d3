"""The encoder: view tokens to latent scene tokens, in a geometry stream and an appearance stream."""

import torch

from .layers import layer_norm, layer_scale, linear, mlp
from .stream import stream_round


def mixer(params, name, geo, app):
    """Computes m = W2 GELU(W1 [LN(geo) ; LN(app)]); each stream adds its half of m, through its own LayerScale."""
    both = torch.cat([layer_norm(params, f"{name}.ln_g", geo), layer_norm(params, f"{name}.ln_t", app)], dim=-1)
    to_geo, to_app = mlp(params, f"{name}.mlp.0", f"{name}.mlp.2", both).chunk(2, dim=-1)
    geo = geo + layer_scale(params, f"{name}.ls_g", to_geo)
    app = app + layer_scale(params, f"{name}.ls_t", to_app)
    return geo, app


def encode(config, params, tokens):
    """Encodes view tokens [B, V, P, e] to (geo, app), each [B, M, d].

    Slots:  4 auxiliary queries, M scene tokens, 1 global token, 4 registers.
    Memory: 4 memory registers, then all V P view tokens.
    config["streams"] = "single" is an ablation with one stream under the geometry names and without a mixer; it returns
    this stream twice.
    """
    batch = tokens.shape[0]
    heads, blocks = config["num_heads"], config["slot_calib_layers_per_round"]
    single = config.get("streams", "dual") == "single"

    def repeat(token):  # [1, n, d] -> [B, n, d]
        return token.expand(batch, -1, -1)

    auxiliary = params["slot_encoder.aux_query_tokens"]
    scene = params["scene_tokens"][None]
    registers = params["slot_encoder.slot_regs"]
    slots = repeat(torch.cat([auxiliary, scene, params["slot_encoder.scale_emb"], registers], dim=1))
    memory = torch.cat([repeat(params["slot_encoder.mem_regs"]), tokens.flatten(1, 2)], dim=1)

    # Registers do not attend to the memory: only self-attention (and the mixer) updates them.
    update_mask = torch.ones(slots.shape[1], 1, dtype=slots.dtype, device=slots.device)
    update_mask[-registers.shape[1] :] = 0.0

    def start(name):
        return linear(params, f"{name}.1", layer_norm(params, f"{name}.0", slots))

    def advance(name, x):
        return stream_round(params, name, x, memory, heads, blocks, update_mask)

    geo = start("slot_encoder.slot_to_geo")
    app = geo if single else start("slot_encoder.slot_to_tex")
    for i in range(config["rounds"]):
        geo = advance(f"slot_encoder.geo_rounds.{i}", geo)
        if single:
            app = geo
            continue
        app = advance(f"slot_encoder.tex_rounds.{i}", app)
        geo, app = mixer(params, f"slot_encoder.pair_adapters.{i}", geo, app)

    first, count = auxiliary.shape[1], scene.shape[1]
    return geo[:, first : first + count], app[:, first : first + count]
