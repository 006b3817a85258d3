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
from zlib import crc32

from program import row, run

# Quantiles of Student's t distribution for 95 % confidence, by the number of samples.
STUDENT = {2: 12.71, 3: 4.30, 4: 3.18, 5: 2.78, 6: 2.57, 7: 2.45, 8: 2.36}


def identity(command):
    """Returns a command's arguments, and a checksum of the files that they refer to, except the argument of --out."""
    inputs = [
        Path(str(argument)) for before, argument in zip(("", *command), command, strict=False) if before != "--out"
    ]
    checksum = 0
    for file in (file for path in inputs for file in sorted([path, *path.rglob("*")]) if file.is_file()):
        with file.open("rb") as opened:
            while block := opened.read(1 << 20):
                checksum = crc32(block, checksum)
    return [*map(str, command), f"{checksum:08x}"]


def run_once(file, *command):
    """Returns the JSON output of a command, cached in `file` for the same arguments and inputs."""
    of = identity(command)
    kept = json.loads(file.read_text()) if file.is_file() else {}
    if kept.get("of") != of:
        kept = {"of": of, "told": run(*command)}
        partial = file.with_suffix(".partial")
        partial.write_text(json.dumps(kept))
        partial.rename(file)
    return kept["told"]


def make_synthetic_captures(out, count):
    """Makes `count` synthetic captures of 48 photos of 512×512, unless they are there, and returns their names."""
    folder = out / f"synthetic_{count}"
    if not (folder / "index.json").is_file():
        run("synth", "--out", folder, "--scenes", str(count), "--frames", "48", "--size", "512")
    chunks = json.loads((folder / "index.json").read_text())
    return [f"{folder / chunk}#{key}" for key, chunk in sorted(chunks.items())]


def scores(out, splat, folder, holdout, size):
    """Returns the scores of a splat on the held-out views."""
    file = out / f"{splat.stem}.scores.json"
    return run_once(file, "eval", "--splat", splat, "--scene", folder, "--holdout", holdout, "--size", size)


def mean(results, name, digits):
    """Formats the mean of the values called `name`, which results may lack."""
    known = [result[name] for result in results if result.get(name) is not None]
    return f"{statistics.mean(known):.{digits}f}" if known else ""


def with_interval(values):
    """Formats the mean of `values` with its 95 % confidence interval."""
    if len(values) not in STUDENT:
        return f"{statistics.mean(values):.2f}"
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
                    splat = file.with_suffix(".ply")
                    command = [
                        "refine",
                        "--scene",
                        folder,
                        "--holdout",
                        holdout,
                        "--seed",
                        str(seed),
                        *shlex.split(more),
                    ]
                    output = run_once(file, *command, "--seconds", str(seconds), "--out", splat)
                    found = scores(arguments.out, splat, folder, holdout, arguments.size)
                    results[name].append({"steps": output["steps"], **found})
                for name, splats in arguments.peer:
                    splat = Path(splats) / f"{capture_name}.{seconds:g}.{seed}.ply"
                    if splat.is_file():
                        kept = arguments.out / name
                        kept.mkdir(exist_ok=True)
                        results[name].append(scores(kept, splat, folder, holdout, arguments.size))
            for name, found in results.items():
                if found:
                    psnr = with_interval([result["psnr"] for result in found])
                    means = [
                        mean(found, *column)
                        for column in (("steps", 0), ("gaussians", 0), ("ssim", 3), ("lpips_vgg", 3))
                    ]
                    row(capture_name, name, f"{seconds:g} s", *means[:2], psnr, *means[2:])


if __name__ == "__main__":
    main()
