"""Helpers for scripts that measure `globalsplat refine`."""

from core_runs import told_once


def refined(file, folder, holdout, seconds, *more):
    """Refines on photos cropped and resized to 256×256; returns the JSON output, held-out scores included.

    The output is cached in `file`.
    """
    command = ["refine", "--scene", folder, "--holdout", holdout, "--size", "256x256", *more]
    return told_once(file, *command, "--seconds", str(seconds), "--out", file.with_suffix(".ply"))
