#!/usr/bin/env python3
"""Compares the full model with its ablations and additions, and with bf16, with equal small budgets and several seeds.

    .venv/bin/python scripts/ablations.py [--out OUT] [--seeds 3] [--only VARIANT ...]

Renders four synthetic scenes, and trains each variant on two thirds of every video's frames; the held-out third scores
it. The model is that of configs/tiny.toml, with larger patches, fewer scene tokens and the paper's consistency loss.
Prints a Markdown table of mean scores ± standard deviation. Runs are in OUT, as many in parallel as there are cores. The
same command resumes where it was stopped.
"""

import argparse
import os
import statistics
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from program import REPOSITORY, digest, row, run_once, with_deviation

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


def train(out, scenes, name, seed):
    """Trains a variant on one core and returns the result, in a folder whose name depends on all settings."""
    settings = [*SETTINGS, *VARIANTS[name], f"train.seed={seed}"]
    identity = digest(CONFIG.read_text(), SYNTH_OPTIONS, settings)
    folder = out / f"{name.replace(' ', '_').replace(',', '')}_{seed}_{identity}"
    folder.mkdir(exist_ok=True)
    command = ["train", "--config", CONFIG, "--out", folder]
    command += [argument for setting in settings for argument in ("--set", setting)]
    environment = dict(os.environ, OMP_NUM_THREADS="1", GLOBALSPLAT_WORLDS=str(scenes))
    return run_once(folder / "result.json", *command, env=environment)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/ablations"))
    parser.add_argument("--seeds", type=int, default=3, help="runs of each variant")
    parser.add_argument("--only", nargs="+", choices=VARIANTS, default=list(VARIANTS), metavar="VARIANT")
    arguments = parser.parse_args()
    out = arguments.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    scenes = out / f"scenes_{digest(SYNTH_OPTIONS)}"
    run_once(scenes.with_suffix(".json"), "synth", "--out", scenes, *SYNTH_OPTIONS)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        seeds = range(arguments.seeds)
        results = {name: [pool.submit(train, out, scenes, name, seed) for seed in seeds] for name in arguments.only}
        row("variant", "held-out PSNR, dB", "SSIM")
        row(*["---"] * 3)
        for name in arguments.only:
            try:
                held_out = [result.result()["held_out"] for result in results[name]]
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
            psnr, ssim = ([scores[key] for scores in held_out] for key in ("psnr", "ssim"))
            row(name, with_deviation(psnr), f"{statistics.mean(ssim):.4f}")
    # All runs have the same values, because the baseline depends on the photos alone.
    psnr, ssim = held_out[0]["nearest_photo_psnr"], held_out[0]["nearest_photo_ssim"]
    row("nearest context photo (baseline)", f"{psnr:.2f}", f"{ssim:.4f}")


if __name__ == "__main__":
    main()
