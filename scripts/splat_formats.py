#!/usr/bin/env python3
"""Measures each splat format: bytes, PSNR between renders, PSNR against photos, and seconds to write and to read.

    .venv/bin/python scripts/splat_formats.py CAPTURE… [--splat reference.ply] [--out OUT]

A capture is a folder with photos, cameras and a splat. Each splat is converted with the capture's cameras (`--scene`)
and without, and scored against the photos. Prints a Markdown table.
"""

import argparse
from pathlib import Path

from program import row, run

ENDINGS = ["ply", "glb", "compressed.ply", "spz", "sog", "splat"]


def photos_psnr(splat, capture):
    return run("eval", "--splat", splat, "--scene", capture)["psnr"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--splat", default="reference.ply")
    parser.add_argument("--out", type=Path, default=Path("runs/splat_formats"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    columns = (
        "splat",
        "format",
        "bytes",
        "dB between renders",
        "PSNR of the photos",
        "without `--scene`",
        "write, s",
        "read, s",
    )
    row(*columns)
    row("---", "---", *["---:"] * 6)
    for capture in arguments.captures:
        original = capture / arguments.splat
        psnr = f"{photos_psnr(original, capture):.2f}"
        row(capture.name, "published", f"{original.stat().st_size:,}", "", psnr, "", "", "")
        for ending in ENDINGS:
            fitted, plain = (arguments.out / f"{capture.name}.{name}.{ending}" for name in ("fitted", "plain"))
            loss = run("convert", original, fitted, "--scene", capture)
            unfitted = run("convert", original, plain)
            scores = [f"{photos_psnr(splat, capture):.2f}" for splat in (fitted, plain)]
            # Pixels that are all the same have no PSNR.
            between = f"{loss['psnr']:.1f}" if loss["psnr"] else "same"
            seconds = [f"{unfitted['to'][key]:.2f}" for key in ("write_seconds", "read_seconds")]
            row(capture.name, f"`.{ending}`", f"{loss['to']['bytes']:,}", between, *scores, *seconds)


if __name__ == "__main__":
    main()
