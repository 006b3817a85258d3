#!/usr/bin/env python3
"""Compares variants of configs/tiny.toml trained for equal time: short runs on one core, one change in each.

    .venv/bin/python scripts/tune.py --worlds DIR --test DIR [--out OUT] [--seconds 300] [--captures DIR]
        [--only VARIANT ...]

--worlds and --test name folders of videos by `globalsplat synth`, 96 pixels wide. Every variant trains for as many
steps as fit in the seconds at its own time per step or, with --scenes N, until it has seen N scenes, which is the fair
budget if models are too small to keep a GPU busy. The curriculum's stages begin at the same fractions of the steps.
Prints a Markdown table: PSNR on unseen synthetic scenes, and mean PSNR on the held-out views of each of the --captures.
Completed runs are not repeated.
"""

import argparse
import json
import os
import statistics
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from core_runs import PROGRAM, REPOSITORY, core_seconds, environment, row, train

# Fractions of the run at which stages begin, and the length of a transition.
STAGES = [0.1, 0.2, 0.35, 0.5]
TRANSITION = 0.05

# Settings for training from scratch: small patches, many scene tokens and Muon only suit weights trained with large
# patches and few tokens first. Without depths and fitted colours, the scores show what the network has learned.
BASE = [
    "model.patch_size=16",
    "model.latents=256",
    "train.optimizer=adamw",
    "data.depths=false",
    "data.colour_steps=0",
]
VARIANTS = {
    "tiny": [],
    "4 to 8 context views": ["data.context_views=8"],
    "4 target views": ["data.target_views=4"],
    "12 target views": ["data.target_views=12"],
    "width 96": ["model.width=96", "model.rgb_width=96", "model.ray_width=48", "model.heads=3"],
    "width 192": ["model.width=192", "model.rgb_width=192", "model.ray_width=96", "model.heads=6"],
    "128 latents": ["model.latents=128"],
    "384 latents": ["model.latents=384"],
    "384 latents, 8 candidates": ["model.latents=384", "model.candidates=8", "curriculum.final_stage=3"],
    "8 candidates": ["model.candidates=8", "curriculum.final_stage=3"],
    "patch 8": ["model.patch_size=8"],
    "patch 12": ["model.patch_size=12"],
    "512 latents": ["model.latents=512"],
    "1 round": ["model.rounds=1"],
    "3 rounds": ["model.rounds=3"],
    "4 rounds": ["model.rounds=4"],
    "8 heads": ["model.heads=8"],
    "batch 1": ["train.batch_size=1"],
    "batch 4": ["train.batch_size=4"],
    "batch 8": ["train.batch_size=8"],
    "Muon": ["train.optimizer=muon"],
    "Muon, batch 8": ["train.optimizer=muon", "train.batch_size=8"],
    "Muon, 4 rounds": ["train.optimizer=muon", "model.rounds=4"],
    "learning rate 2e-3": ["train.learning_rate=2e-3"],
    "learning rate 4e-3": ["train.learning_rate=4e-3"],
    "longer curriculum": ["stages=2"],
    "shorter curriculum": ["stages=0.5"],
    "no curriculum": ["curriculum.full_capacity=true"],
}


def value_of(name, settings, otherwise):
    """Returns the number that the settings, each `NAME=VALUE`, assign to `name`, or `otherwise`."""
    return next(
        (float(setting.removeprefix(f"{name}=")) for setting in settings if setting.startswith(f"{name}=")), otherwise
    )


def steps_in(seconds, config, settings, batch):
    """Returns the number of steps that fit in `seconds`, from the measured CPU time of ten steps."""
    # The mean number of context views of a step, which has 4 to 12 unless the variant sets another maximum.
    views = (4 + int(value_of("data.context_views", settings, 12))) // 2
    command = [PROGRAM, "bench", "train", "--config", config, "--batch", str(batch), "--json"]
    for setting in [*settings, f"data.context_views={views}"]:
        if not setting.startswith("train.batch_size="):
            command += ["--set", setting]
    few, more = (core_seconds([*command, "--steps", str(steps)])[1] for steps in (5, 15))
    return int(10 * seconds / (more - few))


def run(out, name, seconds, scenes, config, worlds, test, captures):
    """Trains and scores a variant.

    Returns the scenes seen, millions of parameters, CPU seconds, PSNR and SSIM on synthetic scenes, and the PSNR of
    each capture.
    """
    settings = BASE + [setting for setting in VARIANTS[name] if not setting.startswith("stages=")]
    longer = value_of("stages", VARIANTS[name], 1.0)
    batch = int(value_of("train.batch_size", settings, 2))
    folder = out / name.replace(" ", "_").replace(",", "")
    folder.mkdir(parents=True, exist_ok=True)
    planned = folder / "steps"
    if not planned.is_file():
        planned.write_text(str(scenes // batch if scenes else steps_in(seconds, config, settings, batch)))
    steps = int(planned.read_text())
    settings += [
        f"train.steps={steps}",
        "train.validate_every=0",
        f'data.validation=["{test}"]',
        "data.threads=1",
        f"curriculum.boundaries={[int(longer * share * steps) for share in STAGES]}",
        f"curriculum.transition={int(longer * TRANSITION * steps)}",
    ]
    told = train(folder / "run", config, settings, GLOBALSPLAT_WORLDS=str(worlds))
    weights = folder / "model.safetensors"
    if not weights.is_file():
        subprocess.run(
            [PROGRAM, "export", "--run", folder / "run", "--out", weights], check=True, stdout=subprocess.DEVNULL
        )
    scores = []
    for capture in captures:
        command = [
            PROGRAM,
            "eval",
            "--weights",
            weights,
            "--scene",
            capture,
            "--views",
            "8",
            "--holdout",
            "every:3+1",
            "--json",
        ]
        text = subprocess.run(command, env=environment(), capture_output=True, text=True, check=True).stdout
        scores.append(json.loads(text)["psnr"])
    held_out = told["held_out"]
    return steps * batch, weights.stat().st_size / 4e6, told["core_seconds"], held_out["psnr"], held_out["ssim"], scores


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=Path, required=True)
    parser.add_argument("--test", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("runs/tune"))
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--seconds", type=float, default=300, help="CPU seconds for each variant")
    either.add_argument("--scenes", type=int, help="number of scenes that each variant is trained on")
    parser.add_argument("--captures", type=Path, nargs="*", default=[])
    parser.add_argument("--only", nargs="+", choices=VARIANTS, default=list(VARIANTS), metavar="VARIANT")
    arguments = parser.parse_args()
    budget = f"{arguments.scenes}_scenes" if arguments.scenes else f"{arguments.seconds:g}_seconds"
    out = arguments.out.absolute() / budget
    config = REPOSITORY / "configs/tiny.toml"
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        several = (
            arguments.seconds,
            arguments.scenes,
            config,
            arguments.worlds.absolute(),
            arguments.test.absolute(),
            arguments.captures,
        )
        results = {name: pool.submit(run, out, name, *several) for name in arguments.only}
        row("variant", "10⁶ parameters", "scenes shown", "seconds of a core", "PSNR, made-up", "SSIM", "PSNR, photos")
        row(*["---"] * 7)
        for name in arguments.only:
            scenes, parameters, seconds, psnr, ssim, photos = results[name].result()
            shown = f"{statistics.mean(photos):.2f}" if photos else ""
            row(name, f"{parameters:.2f}", str(scenes), f"{seconds:.0f}", f"{psnr:.2f}", f"{ssim:.4f}", shown)


if __name__ == "__main__":
    main()
