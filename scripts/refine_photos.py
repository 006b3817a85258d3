#!/usr/bin/env python3
"""What `globalsplat refine` reaches with few photos, begun with photos alone or with the weights that come with it, in each space: PSNR
of views held out.

    .venv/bin/python scripts/refine_photos.py --capture DIR HOLDOUT [--capture …] [--photos 4 6 8 12] [--seconds 10] [--out OUT]

Photos are cut and resized to 256×256, and spread over the camera's path. Prints a Markdown table. Nothing else should run meanwhile.
What is done stays done.
"""

import argparse
import json
import subprocess
from pathlib import Path

from core_runs import PROGRAM, row

WAYS = {
    "photos alone": ["--from", "nothing"],
    "weights": ["--from", "weights"],
    "tokens": ["--space", "tokens"],
    "tokens, then Gaussians": ["--space", "both"],
}


def refined(out, capture, photos, way, seconds):
    """What `refine` told."""
    folder, holdout = capture
    told = out / f"{Path(folder).name}.{photos}.{way.replace(', ', '_').replace(' ', '_')}.json"
    if not told.is_file():
        command = [PROGRAM, "refine", "--scene", folder, "--holdout", holdout, "--size", "256x256", *WAYS[way]]
        command += ["--views", str(photos), "--seconds", str(seconds), "--json", "--out", told.with_suffix(".ply")]
        told.write_text(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)
    return json.loads(told.read_text())


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
    for capture in arguments.capture:
        for photos in arguments.photos:
            told = {way: refined(arguments.out, capture, photos, way, arguments.seconds) for way in WAYS}
            if any(one["photos"] < photos for one in told.values()):
                continue  # the capture hasn't so many
            reached = [f"{told[way]['held_out']['after']['psnr']:.2f}" for way in WAYS]
            row(f"{Path(capture[0]).name}, {photos}", *reached)


if __name__ == "__main__":
    main()
