"""Compares the speed of the program's forward pass with the same model in PyTorch, on the CPU, in one run.

    python parity/model_speed.py [--views 24]    views of 256x256, 16,384 Gaussians, in f32 and in bf16

The PyTorch model is the parity checks' reference; bf16 uses torch.autocast. Weights and photos are random. The program
is measured with `globalsplat bench model`. Both warm up, and are measured alternately, so that other load affects both.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch

# The folder of the package parity.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # noqa: TID251

from parity.harness import draw
from parity.reference.model import forward

PROGRAM = Path(__file__).resolve().parents[1] / "target" / "release" / "globalsplat"
SIZE = 256
ROUNDS = 3  # alternating measurements


def torch_model(views):
    """Returns a function that runs the main model in PyTorch, at a precision, and returns the seconds that it took."""
    rng = np.random.default_rng(0)
    inputs = {"images": draw.uniform(rng, 0.0, 1.0, 1, views, 3, SIZE, SIZE)} | draw.views(rng, 1, views, SIZE, SIZE)
    images, c2w, intrinsics = (torch.from_numpy(inputs[name]) for name in ("images", "c2w", "intrinsics"))
    params = {name: torch.from_numpy(value) for name, value in draw.parameters(rng, draw.MAIN_16K).items()}

    def seconds(precision):
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            start = time.perf_counter()
            forward(draw.MAIN_16K, params, images, c2w, intrinsics, stage=3, mix=1.0)
            return time.perf_counter() - start

    return seconds


def program_seconds(views, precision):
    command = [PROGRAM, "bench", "model", "--views", str(views), "--precision", precision, "--repeats", "1", "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout)["milliseconds"]["median"] * 1e-3


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", metavar="N", type=int, default=24, help="number of photos (default: 24)")
    views = parser.parse_args().views
    torch_seconds = torch_model(views)
    for precision in ("f32", "bf16"):
        torch_seconds(precision)
        times = [(program_seconds(views, precision), torch_seconds(precision)) for _ in range(ROUNDS)]
        ours, theirs = (statistics.median(column) for column in zip(*times, strict=True))
        ratios = [a / b for a, b in times]
        print(
            f"{precision}: program {ours:.2f} s, PyTorch {theirs:.2f} s, ratio {min(ratios):.2f} to {max(ratios):.2f}"
        )


if __name__ == "__main__":
    main()
