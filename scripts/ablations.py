#!/usr/bin/env python3
"""Compares the full model with its ablations and additions, and with bf16, with equal small budgets and several seeds.

Prints mean ± standard deviation.

    .venv/bin/python scripts/ablations.py [--out OUT] [--seeds 3] [--only VARIANT ...]

Renders four synthetic scenes, and trains each variant on two thirds of every video's frames; the held-out third scores
it. The model is that of configs/tiny.toml, with larger patches, fewer scene tokens and the paper's consistency loss.
Runs are in OUT (by default runs/ablations), as many in parallel as there are cores. Prints a Markdown table of the
scores. The same command resumes where it was stopped, and does not repeat completed runs. After a
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

from program import PROGRAM, REPOSITORY, row

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


def train(run, settings, scenes):
    """Trains a run on one core and returns its JSON result, cached in `result.json`."""
    result = run / "result.json"
    if not result.is_file():
        command = [PROGRAM, "train", "--config", CONFIG, "--out", run, "--json"]
        command += [argument for setting in settings for argument in ("--set", setting)]
        environment = dict(os.environ, OMP_NUM_THREADS="1", GLOBALSPLAT_WORLDS=str(scenes))
        output = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True).stdout
        partial = result.with_suffix(".partial")
        partial.write_bytes(output)
        partial.rename(result)
    return json.loads(result.read_text())


def run_folder(out, name, seed):
    return out / f"{name.replace(' ', '_').replace(',', '')}_{seed}"


def format_recipe():
    """Returns the text that determines every result: the configuration, with the other settings as comments."""
    variants = [f"{name}: {settings}" for name, settings in VARIANTS.items()]
    lines = [*SETTINGS, *variants, f"synth {' '.join(SYNTH_OPTIONS)}"]
    return CONFIG.read_text() + "".join(f"# {line}\n" for line in lines)


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
            return train(run_folder(out, name, seed), [*SETTINGS, *VARIANTS[name], f"train.seed={seed}"], scenes)

        results = {name: [pool.submit(run, name, seed) for seed in range(seeds)] for name in arguments.only}
        row("variant", "held-out PSNR, dB", "SSIM")
        row(*["---"] * 3)
        for name in arguments.only:
            try:
                runs = [result.result() for result in results[name]]
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
            psnr, ssim = ([run["held_out"][key] for run in runs] for key in ("psnr", "ssim"))
            spread = f"{statistics.mean(psnr):.2f} ± {statistics.stdev(psnr):.2f}" if seeds > 1 else f"{psnr[0]:.2f}"
            row(name, spread, f"{statistics.mean(ssim):.4f}")
    # All runs have the same values, because the baseline depends on the photos alone.
    held_out = runs[0]["held_out"]
    psnr, ssim = held_out["nearest_photo_psnr"], held_out["nearest_photo_ssim"]
    row("nearest context photo (baseline)", f"{psnr:.2f}", f"{ssim:.4f}")


if __name__ == "__main__":
    main()
