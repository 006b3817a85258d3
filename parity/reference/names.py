"""Conversion of the program's names to the reference's, which are those of the published configurations and weights."""

# Configuration keys of the program, and the published keys.
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


def reference_config(config):
    return {theirs: config[ours] for ours, theirs in CONFIG_NAMES.items()}


def with_prefix(prefix, params):
    """Adds a prefix to parameter names, as requests name them relative to a module, and the reference from the root."""
    return {f"{prefix}.{name}": value for name, value in params.items()}
