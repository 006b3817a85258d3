"""The encoder: view tokens to latent scene tokens, in a geometry stream and an appearance stream."""

import torch

from .layers import attention, layer_norm, layer_scale, linear, mlp


def read_memory(params, name, slots, memory, heads, update_mask):
    """Applies the cross-attention and MLP of a round to slots [B, L, d], memory [B, S, e], update_mask [L, 1].

    slots += mask * LayerScale(Wo Attn(Wq LN(slots), Wk LN(memory), Wv LN(memory)))
    slots += mask * LayerScale(MLP(LN(slots)))
    """
    normed = layer_norm(params, f"{name}.mem_ln", memory)
    q = linear(params, f"{name}.lat_q", layer_norm(params, f"{name}.slots_ln", slots))
    k = linear(params, f"{name}.mem_k", normed)
    v = linear(params, f"{name}.mem_v", normed)
    read = linear(params, f"{name}.out_proj", attention(q, k, v, heads))
    slots = slots + update_mask * layer_scale(params, f"{name}.attn_ls", read)

    update = mlp(params, f"{name}.mlp.0", f"{name}.mlp.2", layer_norm(params, f"{name}.post_ln", slots))
    return slots + update_mask * layer_scale(params, f"{name}.mlp_ls", update)


def self_attention_block(params, name, x, heads):
    """Computes x += LayerScale(Attn(LN x)); x += LayerScale(MLP(LN x)).

    q, k, v are the thirds of the output of one linear layer, in this order.
    """
    q, k, v = linear(params, f"{name}.attn.qkv", layer_norm(params, f"{name}.norm1", x)).chunk(3, dim=-1)
    mixed = linear(params, f"{name}.attn.proj", attention(q, k, v, heads))
    x = x + layer_scale(params, f"{name}.ls1", mixed)

    update = mlp(params, f"{name}.mlp.fc1", f"{name}.mlp.fc2", layer_norm(params, f"{name}.norm2", x))
    return x + layer_scale(params, f"{name}.ls2", update)


def stream_round(params, name, slots, memory, heads, blocks, update_mask):
    """Applies one round of one stream to slots [B, L, d]. Returns [B, L, d]."""
    slots = read_memory(params, name, slots, memory, heads, update_mask)
    for block in range(blocks):
        slots = self_attention_block(params, f"{name}.tower.{block}", slots, heads)
    return slots


def mixer(params, name, geo, app):
    """Computes m = W2 GELU(W1 [LN(geo) ; LN(app)]); each stream adds its half of m, through its own LayerScale."""
    both = torch.cat([layer_norm(params, f"{name}.ln_g", geo), layer_norm(params, f"{name}.ln_t", app)], dim=-1)
    to_geo, to_app = mlp(params, f"{name}.mlp.0", f"{name}.mlp.2", both).chunk(2, dim=-1)
    geo = geo + layer_scale(params, f"{name}.ls_g", to_geo)
    app = app + layer_scale(params, f"{name}.ls_t", to_app)
    return geo, app


def encode(config, params, tokens):
    """Encodes view tokens [B, V P, e] to (geo, app), each [B, M, d].

    Slots:  4 auxiliary queries, M scene tokens, 1 global token, 4 registers.
    Memory: 4 memory registers, then all V P view tokens.
    config["streams"] = "single" is an ablation with one stream under the geometry names and without a mixer; it returns
    this stream twice.
    """
    batch = tokens.shape[0]
    heads, blocks = config["heads"], config["self_attention_blocks"]
    single = config["streams"] == "single"

    def repeat(token):  # [1, n, d] -> [B, n, d]
        return token.expand(batch, -1, -1)

    auxiliary = params["slot_encoder.aux_query_tokens"]
    scene = params["scene_tokens"][None]
    registers = params["slot_encoder.slot_regs"]
    slots = repeat(torch.cat([auxiliary, scene, params["slot_encoder.scale_emb"], registers], dim=1))
    memory = torch.cat([repeat(params["slot_encoder.mem_regs"]), tokens], dim=1)

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
