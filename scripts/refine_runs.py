"""Helpers for scripts that measure `globalsplat refine`."""

from core_runs import told_once

# Arguments of the scripts that compare at the size of the paper's images: photos are cropped and resized.
SMALL = ["--size", "256x256"]


def refined(file, folder, holdout, seconds, *more):
    """Refines with further arguments `more`; returns the JSON output, held-out scores included.

    The output is cached in `file`, and the splat is beside it.
    """
    command = ["refine", "--scene", folder, "--holdout", holdout, *more]
    return told_once(file, *command, "--seconds", str(seconds), "--out", file.with_suffix(".ply"))
