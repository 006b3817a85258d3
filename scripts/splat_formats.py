#!/usr/bin/env python3
"""Measures each splat format: bytes, PSNR between renders, PSNR against photos, and seconds to write and to read.

    .venv/bin/python scripts/splat_formats.py SPLAT CAPTURE [--out OUT]

The splat is converted with the capture's cameras (`--scene`) and without, and scored against the capture's photos. Prints
a Markdown table.
"""

import argparse
from pathlib import Path

from program import row, run

EXTENSIONS = ["ply", "glb", "compressed.ply", "spz", "sog", "splat"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("splat", type=Path)
    parser.add_argument("capture")
    parser.add_argument("--out", type=Path, default=Path("runs/splat_formats"))
    arguments = parser.parse_args()
    splat, views, out = arguments.splat, ("--scene", arguments.capture), arguments.out
    out.mkdir(parents=True, exist_ok=True)

    def photos_psnr(file):
        return f"{run('eval', '--splat', file, *views)['psnr']:.2f}"

    row("format", "bytes", "dB between renders", "PSNR of the photos", "without `--scene`", "write, s", "read, s")
    row("---", *["---:"] * 6)
    row("the original", f"{splat.stat().st_size:,}", "", photos_psnr(splat), "", "", "")
    for extension in EXTENSIONS:
        fitted, plain = (out / f"{splat.stem}.{name}.{extension}" for name in ("fitted", "plain"))
        loss = run("convert", splat, fitted, *views)
        unfitted = run("convert", splat, plain)
        # Pixels that are all the same have no PSNR.
        between = f"{loss['psnr']:.1f}" if loss["psnr"] else "same"
        seconds = [f"{unfitted['to'][key]:.2f}" for key in ("write_seconds", "read_seconds")]
        row(f"`.{extension}`", f"{loss['to']['bytes']:,}", between, photos_psnr(fitted), photos_psnr(plain), *seconds)


if __name__ == "__main__":
    main()
