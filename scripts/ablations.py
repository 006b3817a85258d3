#!/usr/bin/env python3
"""Compares the full model with its ablations and additions, and with bf16, with equal small budgets and several seeds.

Prints mean ± standard deviation.

    .venv/bin/python scripts/ablations.py [--out OUT] [--seeds 3] [--only VARIANT ...]

Renders four synthetic scenes, and trains each variant on two thirds of every video's frames; the held-out third scores
it. The model is that of configs/tiny.toml, with larger patches, fewer scene tokens and the paper's consistency loss.
Runs are in OUT (by default runs/ablations), as many in parallel as there are cores. Prints two Markdown tables: final
scores and learning curves. The same command resumes where it was stopped, and does not repeat completed runs. After a
change to configs/tiny.toml, or to the settings, variants or scenes in this file, OUT must be another folder.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from core_runs import PROGRAM, REPOSITORY, row, train

CONFIG = REPOSITORY / "configs/tiny.toml"
# Settings of all variants. Small patches, many scene tokens and Muon only suit weights trained with large patches and
# few tokens first.
SETTINGS = [
    "model.patch_size=16",
    "model.latents=256",
    "data.image_size=[64, 64]",
    "data.depths=false",
    "data.color_steps=0",
    "data.context_views=8",
    "data.min_context_views=0",
    "data.window=[8, 12]",
    'data.holdout="every:3+1"',
    "data.validation=[]",
    "data.extra_crop=0",
    "data.flip=false",
    "data.jitter={ brightness = 0, contrast = 0, saturation = 0, hue = 0 }",
    "loss.consistency_alpha=1e-3",
    "loss.consistency_depth=1e-2",
    "curriculum.boundaries=[240, 480, 720, 960]",
    "curriculum.transition=80",
    "train.optimizer=adamw",
    "train.steps=2400",
    "train.batch_size=1",
    "train.learning_rate=2e-3",
    "train.checkpoint_every=400",
    "train.validate_every=0",
]
# Options of the scenes that all runs train on.
SYNTH_OPTIONS = ["--scenes", "4", "--frames", "12", "--size", "64", "--seed", "5"]
VARIANTS = {
    "full model": [],
    "Plücker only": ["model.camera_code=false"],
    "no consistency": ["loss.consistency_alpha=0", "loss.consistency_depth=0"],
    # A width with which the model has as many parameters as with two streams.
    "single stream": ["model.streams=single", "model.width=192"],
    "full capacity": ["curriculum.full_capacity=true"],
    "depths": ["data.depths=true"],
    "fitted colors": ["data.color_steps=20"],
    "depths, fitted colors": ["data.depths=true", "data.color_steps=20"],
    "full model, bf16": ["train.precision=bf16"],
}
# Number of equal parts of a run over which its curve is averaged.
PARTS = 6


def run_folder(out, name, seed):
    return out / f"{name.replace(' ', '_').replace(',', '')}_{seed}"


def format_recipe():
    """Returns the text that determines every result: the configuration, with the other settings as comments."""
    variants = [f"{name}: {settings}" for name, settings in VARIANTS.items()]
    lines = [*SETTINGS, *variants, f"synth {' '.join(SYNTH_OPTIONS)}"]
    return CONFIG.read_text() + "".join(f"# {line}\n" for line in lines)


def read_curve(out, name, seeds):
    """Returns the number of steps, and the training PSNR in dB of each of PARTS equal parts of the runs.

    The PSNR is averaged over a part's steps and the seeds.
    """
    parts = [[] for _ in range(PARTS)]
    for seed in range(seeds):
        text = (run_folder(out, name, seed) / "metrics.jsonl").read_text()
        lines = [json.loads(line) for line in text.splitlines()]
        lines = [line for line in lines if "validation" not in line and not line["skipped"]]
        steps = lines[-1]["step"] + 1
        for line in lines:
            parts[line["step"] * PARTS // steps].append(line["psnr"])
    return steps, [statistics.mean(part) for part in parts]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/ablations"))
    parser.add_argument("--seeds", type=int, default=3, help="runs of each variant")
    parser.add_argument("--only", nargs="+", choices=VARIANTS, default=list(VARIANTS), metavar="VARIANT")
    arguments = parser.parse_args()
    out, seeds = arguments.out.absolute(), arguments.seeds
    out.mkdir(parents=True, exist_ok=True)
    recipe, saved_recipe = format_recipe(), out / "recipe.toml"
    if saved_recipe.exists() and saved_recipe.read_text() != recipe:
        sys.exit(f"{saved_recipe} differs from the current recipe: choose another OUT")
    saved_recipe.write_text(recipe)
    scenes = out / "scenes"
    if not (scenes / "evaluation_index.json").is_file():
        subprocess.run([PROGRAM, "synth", "--out", scenes, *SYNTH_OPTIONS], check=True, stdout=sys.stderr)
    with ThreadPoolExecutor(os.cpu_count()) as pool:

        def run(name, seed):
            settings = [*SETTINGS, *VARIANTS[name], f"train.seed={seed}"]
            return train(run_folder(out, name, seed), CONFIG, settings, GLOBALSPLAT_WORLDS=str(scenes))

        results = {name: [pool.submit(run, name, seed) for seed in range(seeds)] for name in arguments.only}
        row("variant", "held-out PSNR, dB", "SSIM", "CPU seconds")
        row(*["---"] * 4)
        for name in arguments.only:
            try:
                runs = [result.result() for result in results[name]]
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
            psnr, ssim = ([run["held_out"][key] for run in runs] for key in ("psnr", "ssim"))
            seconds = statistics.mean(run["core_seconds"] for run in runs)
            spread = f"{statistics.mean(psnr):.2f} ± {statistics.stdev(psnr):.2f}" if seeds > 1 else f"{psnr[0]:.2f}"
            row(name, spread, f"{statistics.mean(ssim):.4f}", f"{seconds:.0f}")
    # All runs have the same values, because the baseline depends on the photos alone.
    held_out = runs[0]["held_out"]
    psnr, ssim = held_out["nearest_photo_psnr"], held_out["nearest_photo_ssim"]
    row("nearest context photo (baseline)", f"{psnr:.2f}", f"{ssim:.4f}", "")

    print()
    for position, name in enumerate(arguments.only):
        steps, psnr = read_curve(out, name, seeds)
        if position == 0:
            row("training PSNR (dB), up to step", *(str(steps * (part + 1) // PARTS) for part in range(PARTS)))
            row(*["---"] * (PARTS + 1))
        row(name, *(f"{value:.2f}" for value in psnr))


if __name__ == "__main__":
    main()
