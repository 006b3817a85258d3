"""Learning rate schedule, curriculum stages, gradient clipping and optimizer steps."""

import math

import torch

WARMUP_FRACTION = 0.03
WARMUP_START = 1e-3
STAGE_BOUNDARIES = (10_000, 20_000, 50_000)
TRANSITION_STEPS = 2_000
LEARNABLE_TOKENS = ("scene_tokens", "scale_emb", "aux_query_tokens", "slot_regs", "mem_regs")


def learning_rate(step, total_steps, peak, warmup_fraction=WARMUP_FRACTION):
    """Returns the rate of update `step`, from 0: linear from 1e-3 peak to peak, then cosine to max(peak / 50, 1e-6)."""
    warmup = warmup_fraction * total_steps
    if step < warmup:
        return peak * (WARMUP_START + (1.0 - WARMUP_START) * step / warmup)
    floor = max(peak / 50.0, 1e-6)
    progress = min(1.0, (step - warmup) / (total_steps - warmup))
    return floor + 0.5 * (peak - floor) * (1.0 + math.cos(math.pi * progress))


def stage(step, final_stage, boundaries=STAGE_BOUNDARIES, transition_steps=TRANSITION_STEPS):
    """Returns (s, lambda): s counts the boundaries reached; lambda goes from 0 to 1 in the steps after the last one."""
    reached = [boundary for boundary in boundaries[:final_stage] if step >= boundary]
    if not reached:
        return 0, 1.0
    return len(reached), min(1.0, (step - reached[-1]) / transition_steps)


def is_decayed(name, parameter):
    """Returns `True` for weight matrices, but not for biases, norms, LayerScale or learnable tokens of any shape."""
    return parameter.dim() >= 2 and name.split(".")[-1] not in LEARNABLE_TOKENS


def clip_gradients(gradients, largest_norm=1.0):
    """Scales all gradients (name -> tensor) by one factor so that their global norm is at most `largest_norm`."""
    norm = torch.sqrt(sum((g**2).sum() for g in gradients.values()))
    factor = (largest_norm / (norm + 1e-6)).clamp(max=1.0)
    return {name: g * factor for name, g in gradients.items()}, norm


def adamw_step(parameter, gradient, first, second, count, rate, decay, beta1=0.9, beta2=0.999, eps=1e-8):
    """Computes an AdamW update, with `count` from 1. Returns the new (parameter, first, second).

    m <- b1 m + (1 - b1) g,   v <- b2 v + (1 - b2) g^2
    p <- p (1 - rate decay) - rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)
    """
    first = beta1 * first + (1.0 - beta1) * gradient
    second = beta2 * second + (1.0 - beta2) * gradient**2
    direction = (first / (1.0 - beta1**count)) / (torch.sqrt(second / (1.0 - beta2**count)) + eps)
    return parameter * (1.0 - rate * decay) - rate * direction, first, second


def orthogonalized(matrix):
    """Orthogonalizes a matrix approximately, by Muon's Newton-Schulz iteration on its singular values.

    Divides the singular values by the Frobenius norm, and replaces each value s by a s + b s^3 + c s^5 five times.
    """
    u, s, vh = torch.linalg.svd(matrix, full_matrices=False)
    s = s / (matrix.norm() + 1e-7)
    for _ in range(5):
        s = 3.4445 * s - 4.7750 * s**3 + 2.0315 * s**5
    return (u * s) @ vh


def muon_step(parameter, gradient, mean, rate, decay, parts=1, beta=0.95):
    """Computes a Muon update of `parts` matrices that are stacked along the first axis. Returns the new (parameter,
    mean).

    m <- b m + (1 - b) g,   u = (1 - b) g + b m,   p <- p (1 - rate decay) - rate 0.2 sqrt(max(R, C)) orthogonalized(u)
    """
    mean = beta * mean + (1.0 - beta) * gradient
    ahead = (1.0 - beta) * gradient + beta * mean
    steps = [0.2 * math.sqrt(max(part.shape)) * orthogonalized(part) for part in ahead.chunk(parts)]
    return parameter * (1.0 - rate * decay) - rate * torch.cat(steps), mean
