#!/usr/bin/env python3
"""Plots the PSNR of held-out views over time in `globalsplat refine`, from photos alone and from the bundled weights.

    .venv/bin/python scripts/refine_curves.py --capture DIR HOLDOUT [VIEWS] [--capture …] [--out OUT] [--seconds 60]

Photos are cropped and resized to 256×256. Writes OUT/curves.svg and prints a Markdown table. Run nothing else
meanwhile. Completed runs are not repeated.
"""

import argparse
from pathlib import Path

from core_runs import SMALL, refined, row
from line_plots import line_plots

STARTS = {"nothing": "photos alone", "weights": "bundled weights"}
SECONDS = [2, 3, 5, 10, 20, 30, 60]


def curve(out, capture, start, seconds):
    """Returns [(seconds, PSNR)] of held-out views; the first entry is that of the initial splat."""
    folder, holdout, *views = capture
    more = ["--from", start, *(["--views", views[0]] if views else [])]
    told = refined(out / f"{Path(folder).name}.{start}.json", folder, holdout, seconds, *SMALL, *more)
    return [(mark["seconds"], mark["psnr"]) for mark in told["held_out"]["curve"]]


def at(marks, seconds):
    """Returns the last PSNR measured by `seconds`, formatted, or an empty string."""
    reached = [psnr for second, psnr in marks if second <= seconds + 0.05]
    return f"{reached[-1]:.1f}" if reached else ""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", nargs="+", action="append", required=True, metavar="DIR HOLDOUT VIEWS")
    parser.add_argument("--out", type=Path, default=Path("runs/refine"))
    parser.add_argument("--seconds", type=float, default=60)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    row("capture", "begins with", *(f"{second} s" for second in SECONDS))
    row(*["---"] * (2 + len(SECONDS)))
    plots = {}
    for capture in arguments.capture:
        curves = {label: curve(arguments.out, capture, start, arguments.seconds) for start, label in STARTS.items()}
        name = Path(capture[0]).name
        for label, points in curves.items():
            row(name, label, *(at(points, second) for second in SECONDS))
        plots[name] = curves
    ticks = range(0, int(arguments.seconds) + 1, 20 if arguments.seconds >= 20 else 5)
    (arguments.out / "curves.svg").write_text(line_plots(plots, ticks))


if __name__ == "__main__":
    main()
