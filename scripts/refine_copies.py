#!/usr/bin/env python3
"""Measures how `globalsplat refine` handles duplicate and near-duplicate photos: PSNR of held-out views.

Bursts, pauses of a video and copied files give captures with such photos.

    .venv/bin/python scripts/refine_copies.py --capture DIR [--holdout 3] [--steps 30] [--size 64x64] [--gaussians 2048]
        [--out OUT]

The capture has a cameras.json. Every third of its photos is held out by default. The others are repeated as CASES says,
at camera positions shifted at random by a fraction of the cameras' extent. Prints a Markdown table.
"""

import argparse
import json
import math
import random
import shutil
from pathlib import Path

from core_runs import row, told

# Copies of each photo, additional copies of the first photo, and standard deviation of their positions relative to the
# cameras' extent.
CASES = [(1, 0, 0.0), (2, 0, 0.0), (2, 0, 1e-7), (5, 0, 1e-4), (10, 0, 1e-3), (3, 0, 1e-2), (1, 40, 1e-4)]


def centre(view):
    return [numbers[3] for numbers in view["c2w"][:3]]


def copied(view, jitter):
    copy = json.loads(json.dumps(view))
    for axis in range(3):
        copy["c2w"][axis][3] += random.gauss(0, jitter)
    return copy


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, required=True, metavar="DIR")
    parser.add_argument("--holdout", type=int, default=3)
    parser.add_argument("--steps", default="30")
    parser.add_argument("--size", default="64x64")
    parser.add_argument("--gaussians", default="2048")
    parser.add_argument("--out", type=Path, default=Path("runs/refine_copies"))
    arguments = parser.parse_args()
    described = json.loads((arguments.capture / "cameras.json").read_text())
    views = described["views"]
    held_out = range(1, len(views), arguments.holdout)
    shown = [view for index, view in enumerate(views) if index not in held_out]
    extent = max(math.dist(centre(a), centre(b)) for a in shown for b in shown)
    row("copies of each photo", "more of the first", "apart", "photos used", "held out, dB")
    row(*["---"] * 5)
    for copies, more, apart in CASES:
        random.seed(0)
        folder = arguments.out / f"{copies}_{more}_{apart:g}"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(arguments.capture, folder)
        several = [view if k == 0 else copied(view, apart * extent) for view in shown for k in range(copies)]
        several += [copied(shown[0], apart * extent) for _ in range(more)]
        (folder / "cameras.json").write_text(json.dumps(described | {"views": several}))
        splat = folder / "splat.ply"
        numbers = ["--steps", arguments.steps, "--size", arguments.size, "--gaussians", arguments.gaussians]
        refined = told("refine", "--scene", folder, "--out", splat, *numbers)
        scores = told("eval", "--splat", splat, "--scene", arguments.capture)["views"]
        psnr = sum(scores[index]["psnr"] for index in held_out) / len(held_out)
        row(str(copies), str(more), f"{apart:g}", str(refined["photos"]), f"{psnr:.2f}")


if __name__ == "__main__":
    main()
