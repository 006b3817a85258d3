#!/usr/bin/env python3
"""Measures how good splats are that `globalsplat refine` optimizes in given times, on views that are held out.

    .venv/bin/python scripts/quality_per_minute.py [--capture DIR [HOLDOUT]]… [--synthetic 4]
        [--variant NAME ARGUMENTS]… [--peer NAME DIR]… [--seconds 30 60 120 300 900] [--seeds 3] [--size 1008] [--out OUT]

HOLDOUT is every:8 by default. --synthetic adds scenes that `globalsplat synth` makes, whose cameras are exact. A
variant is a name and arguments of `refine`, as in `--variant large "--size 1008 --gaussians 100000"`; without one,
the defaults are measured. All splats are scored by `globalsplat eval` on the same pixels: the held-out views with the
longer side --size, or their own if it is smaller. --peer scores the splats of another program alike:
DIR/CAPTURE.SECONDS.SEED.ply, from the other views. Prints a Markdown table of mean PSNR, SSIM and LPIPS (VGG, if
`make weights` was run) over the seeds, with the 95 % confidence interval of PSNR. Every result is kept in OUT and not
repeated. Run nothing else meanwhile.
"""

import argparse
import json
import shlex
import statistics
from pathlib import Path

from core_runs import refined, row, told, told_once

# Quantiles of Student's t distribution for 95 % confidence, by the number of samples.
STUDENT = {2: 12.71, 3: 4.30, 4: 3.18, 5: 2.78, 6: 2.57, 7: 2.45, 8: 2.36}


def make_synthetic_captures(out, count):
    """Makes `count` synthetic captures of 48 photos of 512×512, unless they are there, and returns their names."""
    folder = out / f"synthetic_{count}"
    if not (folder / "index.json").is_file():
        told("synth", "--out", folder, "--scenes", str(count), "--frames", "48", "--size", "512")
    chunks = json.loads((folder / "index.json").read_text())
    return [f"{folder / chunk}#{key}" for key, chunk in sorted(chunks.items())]


def scores(out, splat, folder, holdout, size):
    """Returns the scores of a splat on the held-out views."""
    file = out / f"{splat.stem}.scores.json"
    return told_once(file, "eval", "--splat", splat, "--scene", folder, "--holdout", holdout, "--size", size)


def values_of(name, results):
    """Returns the value called `name` of each result, or None where there is none."""
    return [result.get(name) for result in results]


def mean(values, digits):
    """Formats the mean of `values`, which may lack some."""
    known = [value for value in values if value is not None]
    return f"{statistics.mean(known):.{digits}f}" if known else ""


def with_interval(values):
    """Formats the mean of `values` with its 95 % confidence interval."""
    if len(values) not in STUDENT:
        return mean(values, 2)
    half = STUDENT[len(values)] * statistics.stdev(values) / len(values) ** 0.5
    return f"{statistics.mean(values):.2f} ± {half:.2f}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", nargs="+", action="append", default=[], metavar="DIR HOLDOUT")
    parser.add_argument("--synthetic", type=int, default=0)
    parser.add_argument("--variant", nargs=2, action="append", default=[], metavar=("NAME", "ARGUMENTS"))
    parser.add_argument("--peer", nargs=2, action="append", default=[], metavar=("NAME", "DIR"))
    parser.add_argument("--seconds", type=float, nargs="*", default=[30, 60, 120, 300, 900])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", default="1008")
    parser.add_argument("--out", type=Path, default=Path("runs/quality"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    variants = arguments.variant or [("default", "")]
    synthetic = make_synthetic_captures(arguments.out, arguments.synthetic) if arguments.synthetic else []
    captures = [*arguments.capture, *([name] for name in synthetic)]
    if not captures:
        parser.error("expected --capture or --synthetic")
    row("capture", "method", "time", "steps", "Gaussians", "PSNR, dB", "SSIM", "LPIPS")
    row(*["---"] * 8)
    for folder, *holdout in captures:
        holdout, capture_name = holdout[0] if holdout else "every:8", Path(folder).name.split("#")[-1]
        for seconds in arguments.seconds:
            results = {name: [] for name, _ in [*variants, *arguments.peer]}
            for seed in range(arguments.seeds):
                for name, more in variants:
                    file = arguments.out / f"{name}.{capture_name}.{seconds:g}.{seed}.json"
                    output = refined(file, folder, holdout, seconds, "--seed", str(seed), *shlex.split(more))
                    found = scores(arguments.out, file.with_suffix(".ply"), folder, holdout, arguments.size)
                    results[name].append({"steps": output["steps"], **found})
                for name, splats in arguments.peer:
                    splat = Path(splats) / f"{capture_name}.{seconds:g}.{seed}.ply"
                    if splat.is_file():
                        kept = arguments.out / name
                        kept.mkdir(exist_ok=True)
                        results[name].append(scores(kept, splat, folder, holdout, arguments.size))
            for name, found in results.items():
                if found:
                    time, psnr = f"{seconds:g} s", with_interval(values_of("psnr", found))
                    row(
                        capture_name,
                        name,
                        time,
                        mean(values_of("steps", found), 0),
                        mean(values_of("gaussians", found), 0),
                        psnr,
                        mean(values_of("ssim", found), 3),
                        mean(values_of("lpips_vgg", found), 3),
                    )


if __name__ == "__main__":
    main()
