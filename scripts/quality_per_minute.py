#!/usr/bin/env python3
"""Measures how good splats are that `globalsplat refine` optimizes in given times, on views that are held out.

    .venv/bin/python scripts/quality_per_minute.py --capture CAPTURE [HOLDOUT] [--capture …]
        [--variant NAME ARGUMENTS]… [--peer NAME DIR]… [--seconds 30 60 120 300 900] [--seeds 3] [--size 1008] [--out OUT]

HOLDOUT is every:8 by default. A variant is a name and arguments of `refine`, as in `--variant large "--size 1008
--gaussians 100000"`; without one, the defaults are measured. All splats are scored by `globalsplat eval` on the same
pixels: the held-out views with the longer side --size, or their own if it is smaller. --peer scores the splats of
another program alike: DIR/CAPTURE.SECONDS.SEED.ply, from the other views. Prints a Markdown table of mean PSNR ±
standard deviation, SSIM and LPIPS (VGG, if `make weights` was run) over the seeds. Splats are kept in OUT and not
optimized again: choose another OUT after a change of the program or of a capture. Run nothing else meanwhile.
"""

import argparse
import shlex
import statistics
from pathlib import Path

from program import digest, row, run, run_once, with_deviation


def mean(results, name, digits):
    """Formats the mean of the values called `name`, which results may lack."""
    known = [result[name] for result in results if result.get(name) is not None]
    return f"{statistics.mean(known):.{digits}f}" if known else ""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", nargs="+", action="append", required=True, metavar="CAPTURE HOLDOUT")
    parser.add_argument("--variant", nargs=2, action="append", default=[], metavar=("NAME", "ARGUMENTS"))
    parser.add_argument("--peer", nargs=2, action="append", default=[], metavar=("NAME", "DIR"))
    parser.add_argument("--seconds", type=float, nargs="*", default=[30, 60, 120, 300, 900])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", default="1008")
    parser.add_argument("--out", type=Path, default=Path("runs/quality"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    row("capture", "method", "time", "steps", "Gaussians", "PSNR, dB", "SSIM", "LPIPS")
    row(*["---"] * 8)
    for capture, *holdout in arguments.capture:
        views = ["--scene", capture, "--holdout", holdout[0] if holdout else "every:8"]
        capture_name = Path(capture).name.split("#")[-1]
        for seconds in arguments.seconds:

            def refine(options, seed, views=views, name=capture_name, seconds=seconds):
                """Returns a splat and the result of the command that made it."""
                command = ["refine", *views, "--seed", seed, *shlex.split(options), "--seconds", seconds]
                splat = arguments.out / f"{name}.{digest(command)}.ply"
                return splat, run_once(splat.with_suffix(".json"), *command, "--out", splat)

            seeds = range(arguments.seeds)
            made = {
                name: [refine(options, seed) for seed in seeds]
                for name, options in arguments.variant or [("default", "")]
            }
            for name, folder in arguments.peer:
                files = [Path(folder) / f"{capture_name}.{seconds:g}.{seed}.ply" for seed in seeds]
                made[name] = [(file, {}) for file in files if file.is_file()]
            for name, splats in made.items():
                scores = [
                    made_by | run("eval", "--splat", splat, *views, "--size", arguments.size)
                    for splat, made_by in splats
                ]
                if scores:
                    psnr = with_deviation([score["psnr"] for score in scores])
                    columns = (("steps", 0), ("gaussians", 0), ("ssim", 3), ("lpips_vgg", 3))
                    steps, count, ssim, lpips = (mean(scores, *column) for column in columns)
                    row(capture_name, name, f"{seconds:g} s", steps, count, psnr, ssim, lpips)


if __name__ == "__main__":
    main()
