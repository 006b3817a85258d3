"""The step of the optimizer Muon."""

import math

import torch


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
