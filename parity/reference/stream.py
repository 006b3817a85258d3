"""One stream of the encoder: cross-attention of the slots to the memory, then self-attention among the slots."""

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
