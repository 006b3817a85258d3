#!/usr/bin/env python3
"""Measures size and quality of each splat format: bytes, PSNR between renders, and PSNR against photos.

    .venv/bin/python scripts/splat_formats.py CAPTURE… [--splat reference.ply] [--out OUT]

A capture is a folder with photos, cameras and a splat. Each splat is converted with the capture's cameras (`--scene`)
and without, and scored against the photos. Prints a Markdown table.
"""

import argparse
from pathlib import Path

from core_runs import row, told

ENDINGS = ["ply", "compressed.ply", "spz", "splat"]


def photos_psnr(splat, capture):
    return told("eval", "--splat", splat, "--scene", capture)["psnr"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--splat", default="reference.ply")
    parser.add_argument("--out", type=Path, default=Path("runs/splat_formats"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    row("splat", "format", "bytes", "dB between renders", "PSNR of the photos", "without `--scene`")
    row("---", "---", *["---:"] * 4)
    for capture in arguments.captures:
        original = capture / arguments.splat
        row(capture.name, "published", f"{original.stat().st_size:,}", "", f"{photos_psnr(original, capture):.2f}", "")
        for ending in ENDINGS:
            fitted, plain = (arguments.out / f"{capture.name}.{name}.{ending}" for name in ("fitted", "plain"))
            loss = told("convert", original, fitted, "--scene", capture)
            told("convert", original, plain)
            scores = [f"{photos_psnr(splat, capture):.2f}" for splat in (fitted, plain)]
            row(capture.name, f"`.{ending}`", f"{loss['to']['bytes']:,}", f"{loss['psnr']:.1f}", *scores)


if __name__ == "__main__":
    main()
