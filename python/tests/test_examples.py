"""The examples run, and do what they say."""

import re
import subprocess
import sys
from pathlib import Path

import globalsplat
import numpy as np
from PIL import Image

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name, *arguments):
    command = [sys.executable, "-P", EXAMPLES / name, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_gaussians_fit_an_image(tmp_path):
    x, y = np.meshgrid(np.linspace(0, 3, 48), np.linspace(0, 2, 32))
    pixels = np.stack([0.5 + 0.4 * np.sin(4 * x), 0.5 + 0.4 * np.cos(5 * y), 0.5 + 0.4 * np.sin(3 * x * y)], -1)
    Image.fromarray((pixels * 255).astype(np.uint8)).save(tmp_path / "image.png")
    output = run("fit_image.py", tmp_path / "image.png", tmp_path / "fitted.png")
    assert float(re.findall(r"difference (\d\.\d+)", output)[-1]) < 0.02
    fitted = np.asarray(Image.open(tmp_path / "fitted.png"), np.float32) / 255
    assert np.abs(fitted - pixels).mean() < 0.025


def test_gsplat_s_densification_runs_on_the_op(capture_folder, tmp_path):
    output = run("simple_trainer.py", capture_folder, tmp_path / "splat.ply", "310")
    count = int(re.findall(r"(\d+) Gaussians", output)[-1])
    assert len(globalsplat.load_splat(tmp_path / "splat.ply")["means"]) > count  # the last steps aren't printed
