#!/usr/bin/env python3
"""Measures the PSNR of held-out views that `globalsplat refine` reaches with few photos.

It starts from photos alone or from the shipped weights.

    .venv/bin/python scripts/refine_photos.py --capture DIR HOLDOUT [--capture …] [--photos 4 6 8 12] [--seconds 10]
        [--out OUT]

Photos are cropped and resized to 256×256, and spread over the camera's path. Prints a Markdown table. Run nothing else
meanwhile. Completed runs are not repeated.
"""

import argparse
from pathlib import Path

from core_runs import row
from refine_runs import SMALL, refined

WAYS = {
    "photos alone": ["--from", "nothing"],
    "weights": ["--from", "weights"],
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", nargs=2, action="append", required=True, metavar=("DIR", "HOLDOUT"))
    parser.add_argument("--photos", type=int, nargs="+", default=[4, 6, 8, 12])
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--out", type=Path, default=Path("runs/refine_photos"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    row("capture, photos", *WAYS)
    row(*["---"] * (1 + len(WAYS)))
    for folder, holdout in arguments.capture:
        name = Path(folder).name
        for photos in arguments.photos:
            told = {}
            for way, options in WAYS.items():
                file = arguments.out / f"{name}.{photos}.{way.replace(' ', '_')}.json"
                more = [*SMALL, *options, "--views", str(photos)]
                told[way] = refined(file, folder, holdout, arguments.seconds, *more)
            if any(one["photos"] < photos for one in told.values()):
                continue  # the capture has fewer photos
            reached = [f"{told[way]['held_out']['after']['psnr']:.2f}" for way in WAYS]
            row(f"{name}, {photos}", *reached)


if __name__ == "__main__":
    main()
