"""Runs of `globalsplat refine`: what scripts that measure it share."""

from core_runs import told_once


def refined(file, folder, holdout, seconds, *more):
    """What a run told of photos cut and resized to 256×256, views held out included. It is kept in `file`, and isn't made again."""
    command = ["refine", "--scene", folder, "--holdout", holdout, "--size", "256x256", *more]
    return told_once(file, *command, "--seconds", str(seconds), "--out", file.with_suffix(".ply"))
