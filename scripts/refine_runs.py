"""Runs of `globalsplat refine`: what scripts that measure it share."""

import json
import subprocess

from core_runs import PROGRAM


def refined(told, folder, holdout, seconds, *more):
    """What a run told of photos cut and resized to 256×256, views held out included. It is kept in the file `told`, and isn't made
    again."""
    if not told.is_file():
        command = [PROGRAM, "refine", "--scene", folder, "--holdout", holdout, "--size", "256x256", *more]
        command += ["--seconds", str(seconds), "--json", "--out", told.with_suffix(".ply")]
        told.write_text(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)
    return json.loads(told.read_text())
