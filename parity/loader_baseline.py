"""Compares the program's data loader with a typical Python pipeline on the same chunks, in one run.

    python parity/loader_baseline.py                      measures both alternately, and prints the speedup
    python parity/loader_baseline.py --data ROOT          uses a dataset of chunks with an index.json
    python parity/loader_baseline.py --data ROOT --alone  measures only the Python pipeline

The pipeline is a torch DataLoader with two workers, each with its own chunks, which torch.load reads. PIL decodes,
crops and resizes with Lanczos in one call; ImageEnhance and HSV jitter colours as torchvision's ColorJitter does; numpy
and torch convert to float tensors. Views and augmentation are sampled as in the program: 24 context and 12 target views
from a window of 40 to 220 frames, where a frame in both sets is decoded once, and a crop around the principal point
that is up to a tenth smaller than the largest one.
"""

import argparse
import io
import json
import random
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageEnhance
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

REPOSITORY = Path(__file__).resolve().parents[1]
CONTEXT, TARGET, WINDOW, SIZE = 24, 12, (40, 220), 256
EXTRA_CROP = 0.1
BRIGHTNESS, CONTRAST, SATURATION, HUE = 0.3, 0.4, 0.3, 0.1


def turn_hue(image, turn):
    """Adds to the 8-bit hue with wraparound, as torchvision does for PIL images."""
    hue, saturation, value = image.convert("HSV").split()
    shifted = np.array(hue, dtype=np.uint8) + np.array(turn * 255).astype(np.uint8)
    return Image.merge("HSV", (Image.fromarray(shifted), saturation, value)).convert("RGB")


def draw_jitter():
    """Samples the colour jitter: a list of functions image -> image, to be applied to all views of a sample."""

    def enhance(enhancer, strength):
        factor = random.uniform(1 - strength, 1 + strength)
        return lambda image: enhancer(image).enhance(factor)

    turn = random.uniform(-HUE, HUE)
    adjustments = [
        enhance(ImageEnhance.Brightness, BRIGHTNESS),
        enhance(ImageEnhance.Contrast, CONTRAST),
        enhance(ImageEnhance.Color, SATURATION),
        lambda image: turn_hue(image, turn),
    ]
    random.shuffle(adjustments)
    return adjustments


def sample(scene):
    """Samples views of a scene. Returns a dict of tensors.

    "context" and "target" are images [V, 3, H, W] in [0, 1]; "intrinsics" and "w2c" are of context, then target views.
    """
    images, cameras = scene["images"], scene["cameras"]
    length = min(random.randint(*WINDOW), len(images))
    start = random.randint(0, len(images) - length)
    context = sorted(random.sample(range(start, start + length), CONTEXT))
    target = sorted(random.sample(range(start, start + length), TARGET))
    zoom = 1 + random.uniform(0, EXTRA_CROP)
    shift_x, shift_y = random.random(), random.random()
    jitter = draw_jitter()

    pictures, intrinsics = {}, {}
    for frame in sorted({*context, *target}):
        image = Image.open(io.BytesIO(images[frame].numpy().tobytes())).convert("RGB")
        width, height = image.size
        fx, fy, cx, cy = (cameras[frame, :4] * torch.tensor([width, height, width, height])).tolist()
        side = 2 * min(cx, width - cx, cy, height - cy)
        shown = side / zoom
        left, top = cx - side / 2 + shift_x * (side - shown), cy - side / 2 + shift_y * (side - shown)
        box = (left, top, left + shown, top + shown)
        image = image.resize((SIZE, SIZE), Image.LANCZOS, box=box)
        for adjust in jitter:
            image = adjust(image)
        pictures[frame] = torch.from_numpy(np.array(image)).permute(2, 0, 1).contiguous().float().div(255)
        scale = SIZE / shown
        intrinsics[frame] = torch.tensor([fx * scale, fy * scale, (cx - left) * scale, (cy - top) * scale])
    return {
        "context": torch.stack([pictures[frame] for frame in context]),
        "target": torch.stack([pictures[frame] for frame in target]),
        "intrinsics": torch.stack([intrinsics[frame] for frame in [*context, *target]]),
        "w2c": cameras[[*context, *target], 6:].reshape(-1, 3, 4),
    }


class Chunks(IterableDataset):
    """An endless dataset of samples: chunks in random order, every scene of a chunk once."""

    def __init__(self, root):
        self.paths = sorted(root / name for name in set(json.loads((root / "index.json").read_text()).values()))

    def __iter__(self):
        worker = get_worker_info()
        paths = self.paths[worker.id :: worker.num_workers]
        random.seed(worker.id)
        while True:
            random.shuffle(paths)
            for path in paths:
                scenes = torch.load(path, weights_only=True)
                random.shuffle(scenes)
                for scene in scenes:
                    if len(scene["images"]) >= WINDOW[0]:
                        yield sample(scene)


def python_views_per_second(root, workers, samples, warm_up=4):
    torch.set_num_threads(1)
    loader = iter(DataLoader(Chunks(root), batch_size=None, num_workers=workers))
    views = 0
    for turn in range(warm_up + samples):
        if turn == warm_up:
            start = time.perf_counter()
        batch = next(loader)
        if turn >= warm_up:
            views += len(batch["context"]) + len(batch["target"])
    return views / (time.perf_counter() - start)


def program(binary, *arguments):
    done = subprocess.run([binary, "bench", "loader", "--json", *arguments], stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout)


def compare(options, root):
    """Measures both loaders alternately, so that other load on the machine affects both."""
    ours, theirs = [], []
    for _ in range(options.rounds):
        threads = ["--data", str(root), "--threads", str(options.workers), "--samples", str(options.samples)]
        ours.append(program(options.binary, *threads)["views_per_second"])
        alone = [sys.executable, __file__, "--data", str(root), "--alone"]
        alone += ["--workers", str(options.workers), "--samples", str(options.samples)]
        done = subprocess.run(alone, stdout=subprocess.PIPE, check=True)
        theirs.append(json.loads(done.stdout)["views_per_second"])
        print(f"program {ours[-1]:.0f} views/s, Python {theirs[-1]:.0f} views/s", file=sys.stderr)
    ratios = [a / b for a, b in zip(ours, theirs)]
    return {
        "program_views_per_second": statistics.median(ours),
        "python_views_per_second": statistics.median(theirs),
        "ratio": statistics.median(ratios),
        "ratios": ratios,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", metavar="ROOT", type=Path, help="chunks and index.json (default: synthetic)")
    parser.add_argument("--alone", action="store_true", help="measure only the Python pipeline")
    parser.add_argument("--workers", metavar="N", type=int, default=2, help="workers of each loader (default: 2)")
    parser.add_argument("--samples", metavar="N", type=int, default=40, help="measured samples of each (default: 40)")
    parser.add_argument("--rounds", metavar="N", type=int, default=5, help="alternating measurements (default: 5)")
    parser.add_argument("--binary", metavar="PATH", default=str(REPOSITORY / "target" / "release" / "globalsplat"))
    options = parser.parse_args()
    if options.alone:
        if not options.data:
            parser.error("--alone needs --data")
        rate = python_views_per_second(options.data, options.workers, options.samples)
        print(json.dumps({"views_per_second": rate, "workers": options.workers}))
        return
    with tempfile.TemporaryDirectory() as folder:
        root = options.data
        if root is None:
            root = Path(folder)
            program(options.binary, "--keep", folder, "--samples", "1")
        print(json.dumps(compare(options, root)))


if __name__ == "__main__":
    main()
