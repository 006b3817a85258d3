#!/usr/bin/env python3
"""The full model against its four ablations at small scale: same budget, three seeds each, mean and spread.

    .venv/bin/python scripts/ablations.py [OUT]

Makes rooms, trains configs/small.toml and each variant in OUT (runs/ablations by default), and prints a Markdown table. What is
done stays done: the same command goes on where it was stopped.
"""

import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAM = REPOSITORY / "target/release/globalsplat"
SEEDS = (0, 1, 2)
VARIANTS = {
    "full model": [],
    "Plücker only": ["model.camera_code=false"],
    "no consistency": ["loss.consistency_alpha=0", "loss.consistency_depth=0"],
    # As wide as makes it as large as the two streams.
    "single stream": ["model.streams=single", "model.width=144"],
    "full capacity": ["curriculum.full_capacity=true"],
}


def trained(out, name, seed, settings, rooms):
    """What a run told at its end, which OUT keeps."""
    run = out / f"{name.replace(' ', '_')}_{seed}"
    result = run / "result.json"
    if not result.is_file():
        command = [PROGRAM, "train", "--config", REPOSITORY / "configs/small.toml", "--out", run, "--json"]
        for setting in [*settings, f"train.seed={seed}"]:
            command += ["--set", setting]
        environment = dict(os.environ, GLOBALSPLAT_ROOMS=str(rooms))
        told = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
        result.write_text(told)
    return json.loads(result.read_text())


def main():
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/ablations").absolute()
    rooms = out / "rooms"
    if not rooms.is_dir():
        command = [PROGRAM, "synth", "--out", rooms, "--scenes", "8", "--frames", "18", "--size", "64", "--seed", "5"]
        subprocess.run(command, check=True, stdout=sys.stderr)
    print("| variant | held-out PSNR, dB | SSIM | seconds |")
    print("|---|---|---|---|")
    for name, settings in VARIANTS.items():
        runs = [trained(out, name, seed, settings, rooms) for seed in SEEDS]
        psnr, ssim = ([run["held_out"][key] for run in runs] for key in ("psnr", "ssim"))
        seconds = statistics.mean(run["seconds"] for run in runs)
        spread = f"{statistics.mean(psnr):.2f} ± {statistics.stdev(psnr):.2f}"
        print(f"| {name} | {spread} | {statistics.mean(ssim):.4f} | {seconds:.0f} |", flush=True)
    nearest = runs[0]["held_out"]
    print(f"| the nearest photo shown | {nearest['nearest_photo_psnr']:.2f} | {nearest['nearest_photo_ssim']:.4f} | |")


if __name__ == "__main__":
    main()
