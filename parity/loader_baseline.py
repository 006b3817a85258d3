"""Compares the program's data loader with a typical Python pipeline on the same chunks, in one run.

    python parity/loader_baseline.py                      measures both alternately on synthetic chunks
    python parity/loader_baseline.py --data ROOT          measures both on a dataset of chunks with an index.json
    python parity/loader_baseline.py --data ROOT --alone  measures only the Python pipeline

The result is a JSON object. "ratio" is the median of the speedups that the rounds measure.

The Python pipeline is a torch DataLoader with two workers. Each worker reads its own chunks with torch.load. PIL
decodes photos; one of its calls crops them and resizes them with Lanczos. ImageEnhance and HSV jitter colours as
torchvision's ColorJitter does. numpy and torch convert the result to float tensors. Views and augmentation are sampled
as in the program. A sample has 24 context and 12 target views from a window of 40 to 220 frames. A frame that is in
both sets is decoded once. The crop is around the principal point, and up to a tenth smaller than the largest possible
one.
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


def shift_hue(image, shift):
    """Adds `shift`, a fraction of the colour circle, to the hue. Hues of 8 bits wrap around, as in torchvision."""
    hue, saturation, value = image.convert("HSV").split()
    shifted = np.array(hue, dtype=np.uint8) + np.array(shift * 255).astype(np.uint8)
    return Image.merge("HSV", (Image.fromarray(shifted), saturation, value)).convert("RGB")


def draw_jitter():
    """Samples a colour jitter for all views of a sample. Returns functions image -> image, to be applied in order."""

    def enhance(enhancer, strength):
        factor = random.uniform(1 - strength, 1 + strength)
        return lambda image: enhancer(image).enhance(factor)

    shift = random.uniform(-HUE, HUE)
    adjustments = [
        enhance(ImageEnhance.Brightness, BRIGHTNESS),
        enhance(ImageEnhance.Contrast, CONTRAST),
        enhance(ImageEnhance.Color, SATURATION),
        lambda image: shift_hue(image, shift),
    ]
    random.shuffle(adjustments)
    return adjustments


def sample(scene):
    """Samples views of a scene. Returns a dict of tensors.

    "context" and "target" are images [V, 3, H, W] in [0, 1]. "intrinsics" [V, 4] and "w2c" [V, 3, 4] hold the context
    views first, then the target views.
    """
    images, cameras = scene["images"], scene["cameras"]
    length = min(random.randint(*WINDOW), len(images))
    start = random.randint(0, len(images) - length)
    context = sorted(random.sample(range(start, start + length), CONTEXT))
    target = sorted(random.sample(range(start, start + length), TARGET))
    zoom = 1 + random.uniform(0, EXTRA_CROP)
    shift_x, shift_y = random.random(), random.random()
    jitter = draw_jitter()

    tensors, intrinsics = {}, {}
    for frame in sorted({*context, *target}):
        image = Image.open(io.BytesIO(images[frame].numpy().tobytes())).convert("RGB")
        width, height = image.size
        fx, fy, cx, cy = (cameras[frame, :4] * torch.tensor([width, height, width, height])).tolist()
        side = 2 * min(cx, width - cx, cy, height - cy)
        crop_side = side / zoom
        left, top = cx - side / 2 + shift_x * (side - crop_side), cy - side / 2 + shift_y * (side - crop_side)
        box = (left, top, left + crop_side, top + crop_side)
        image = image.resize((SIZE, SIZE), Image.Resampling.LANCZOS, box=box)
        for adjust in jitter:
            image = adjust(image)
        tensors[frame] = torch.from_numpy(np.array(image)).permute(2, 0, 1).contiguous().float().div(255)
        scale = SIZE / crop_side
        intrinsics[frame] = torch.tensor([fx * scale, fy * scale, (cx - left) * scale, (cy - top) * scale])
    return {
        "context": torch.stack([tensors[frame] for frame in context]),
        "target": torch.stack([tensors[frame] for frame in target]),
        "intrinsics": torch.stack([intrinsics[frame] for frame in [*context, *target]]),
        "w2c": cameras[[*context, *target], 6:].reshape(-1, 3, 4),
    }


class Chunks(IterableDataset):
    """Endless dataset of samples. Each pass reads the chunks in random order, and every scene of a chunk once."""

    def __init__(self, root):
        self.paths = sorted(root / name for name in set(json.loads((root / "index.json").read_text()).values()))

    def __iter__(self):
        worker = get_worker_info()
        assert worker is not None, "the loader has workers"
        paths = self.paths[worker.id :: worker.num_workers]
        random.seed(worker.id)
        # A worker without chunks has no samples.
        while paths:
            random.shuffle(paths)
            for path in paths:
                scenes = torch.load(path, weights_only=True)
                random.shuffle(scenes)
                for scene in scenes:
                    if len(scene["images"]) >= WINDOW[0]:
                        yield sample(scene)


def python_views_per_second(root, workers, samples, warm_up=4):
    """Measures the Python pipeline over `samples` samples after `warm_up` unmeasured ones."""
    torch.set_num_threads(1)
    loader = iter(DataLoader(Chunks(root), batch_size=None, num_workers=workers))
    views = 0
    for step in range(warm_up + samples):
        if step == warm_up:
            start = time.perf_counter()
        batch = next(loader)
        if step >= warm_up:
            views += len(batch["context"]) + len(batch["target"])
    return views / (time.perf_counter() - start)


def run_program(binary, *arguments):
    """Runs `globalsplat bench loader` and returns its JSON report."""
    completed = subprocess.run([binary, "bench", "loader", "--json", *arguments], stdout=subprocess.PIPE, check=True)
    return json.loads(completed.stdout)


def compare(options, root):
    """Measures both loaders alternately, so that other load on the machine affects both."""
    ours, theirs = [], []
    for _ in range(options.rounds):
        arguments = ["--data", str(root), "--threads", str(options.workers), "--samples", str(options.samples)]
        ours.append(run_program(options.binary, *arguments)["views_per_second"])
        command = [sys.executable, __file__, "--data", str(root), "--alone"]
        command += ["--workers", str(options.workers), "--samples", str(options.samples)]
        completed = subprocess.run(command, stdout=subprocess.PIPE, check=True)
        theirs.append(json.loads(completed.stdout)["views_per_second"])
        print(f"program {ours[-1]:.0f} views/s, Python {theirs[-1]:.0f} views/s", file=sys.stderr)
    ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
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
            run_program(options.binary, "--keep", folder, "--samples", "1")
        print(json.dumps(compare(options, root)))


if __name__ == "__main__":
    main()
