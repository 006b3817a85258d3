#!/usr/bin/env python3
"""Measures how input and render resolution affect a model's scores: PSNR and SSIM of held-out views, and time.

    .venv/bin/python scripts/high_resolution.py --capture DIR HOLDOUT [--capture …] [--trained 96] [--phase 2]
        [--pictures 96 192] [--views N] [--weights models/tiny.safetensors] [--out OUT]

Prints a Markdown table for each capture. Completed evaluations are not repeated.
"""

import argparse
from pathlib import Path

from core_runs import row, told_once

SETTINGS = {"small": "as in training", "polyphase": "polyphase"}


def scored(arguments, capture, setting, phase, pictures):
    """Returns the JSON output of `eval` for one capture, input setting and render size."""
    folder, holdout = capture
    command = ["eval", "--weights", arguments.weights, "--scene", folder, "--holdout", holdout]
    command += ["--views", str(arguments.views), "--pictures-at", str(pictures)]
    if setting != "small":
        command += ["--views-at", str(phase * arguments.trained)]
    return told_once(arguments.out / f"{Path(folder).name}.{setting}.{phase}.{pictures}.json", *command)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", nargs=2, action="append", required=True, metavar=("DIR", "HOLDOUT"))
    parser.add_argument("--trained", type=int, default=96, help="height in pixels of the images in training")
    parser.add_argument("--phase", type=int, nargs="+", default=[2])
    parser.add_argument("--pictures", type=int, nargs="+", default=[96, 192])
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--weights", default="models/tiny.safetensors")
    parser.add_argument("--out", type=Path, default=Path("runs/high_resolution"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for capture in arguments.capture:
        print(f"\n{Path(capture[0]).name}:\n")
        row("shown", "views", *(f"pictures of {size}×{size}" for size in arguments.pictures), "passes, s")
        row(*["---"] * (3 + len(arguments.pictures)))
        settings = [("small", 1)] + [(name, phase) for phase in arguments.phase for name in SETTINGS if name != "small"]
        for name, phase in settings:
            told = [scored(arguments, capture, name, phase, size) for size in arguments.pictures]
            side = phase * arguments.trained
            scores = [f"{one['psnr']:.2f} / {one['ssim']:.3f}" for one in told]
            seconds = min(one["forward_seconds"] for one in told)
            row(
                SETTINGS[name] + (f", {side}" if phase > 1 else ""),
                str(told[0]["input"]["views"]),
                *scores,
                f"{seconds:.2f}",
            )
        nearest = [one["baselines"]["nearest_photo"] for one in told]
        row("the nearest photo", "", *(f"{one['psnr']:.2f} / {one['ssim']:.3f}" for one in nearest), "")


if __name__ == "__main__":
    main()
