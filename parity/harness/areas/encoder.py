"""From the tokens of all views to the latents of the scene."""

import reference.encoder
import reference.stream
import torch

from .. import draw
from ..draw import normal, whole
from ..names import reference_config, under
from ..registry import Draw, by, case, twin

REGISTERS = 4  # the last slots of a stream


@case
def stream_round(rng):
    """One round of one stream: slots read the memory, then each other."""
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


@twin("stream_round")
def stream_round_twin(config, params, inputs):
    slots, memory = inputs["slots"], inputs["memory"]
    mask = torch.ones(slots.shape[1], 1, dtype=slots.dtype)
    mask[-REGISTERS:] = 0.0
    heads, blocks = config["heads"], config["self_attention_blocks"]
    return {"slots": reference.stream.stream_round(under("round", params), "round", slots, memory, heads, blocks, mask)}


@case
def self_attention_block(rng):
    """From one slot on, which has only itself to read."""
    for _ in range(3):
        config = draw.model_config(rng)
        slots = normal(rng, whole(rng, 1, 3), whole(rng, 1, 15), config["width"])
        params = draw.parameters(rng, config, "slot_encoder.geo_rounds.0.tower.0.")
        yield Draw(f"{by(*slots.shape)}, heads {config['heads']}", {"slots": slots}, config, params, ("slots",))


@twin("self_attention_block")
def self_attention_block_twin(config, params, inputs):
    params = under("block", params)
    return {"slots": reference.stream.self_attention_block(params, "block", inputs["slots"], config["heads"])}


@case
def mixer(rng):
    """What the two streams tell each other after a round."""
    for _ in range(3):
        config = draw.model_config(rng)
        shape = whole(rng, 1, 3), whole(rng, 1, 15), config["width"]
        inputs = {"geometry": normal(rng, *shape), "appearance": normal(rng, *shape)}
        params = draw.parameters(rng, config, "slot_encoder.pair_adapters.0.")
        yield Draw(by(*shape), inputs, config, params, ("geometry", "appearance"))


@twin("mixer")
def mixer_twin(config, params, inputs):
    params = under("mixer", params)
    geometry, appearance = reference.encoder.mixer(params, "mixer", inputs["geometry"], inputs["appearance"])
    return {"geometry": geometry, "appearance": appearance}


@case
def encoder(rng):
    """All rounds, of two streams and of the ablation's single one."""
    for streams in ("dual", "dual", "single"):
        config = draw.model_config(rng, streams=streams)
        shape = whole(rng, 1, 3), whole(rng, 4, 40), config["ray_width"] + config["rgb_width"]
        params = draw.parameters(rng, config)
        params = {name: value for name, value in params.items() if name.startswith(("scene_tokens", "slot_encoder"))}
        label = f"{by(*shape)}, slots {by(config['latents'], config['width'])}, rounds {config['rounds']}, {streams}"
        yield Draw(label, {"tokens": normal(rng, *shape)}, config, params, ("tokens",))


@twin("encoder")
def encoder_twin(config, params, inputs):
    tokens = inputs["tokens"][:, None]  # as of one view: the encoder doesn't tell views apart
    geometry, appearance = reference.encoder.encode(reference_config(config), params, tokens)
    return {"geometry": geometry, "appearance": appearance}
