#!/usr/bin/env python3
"""Trains a tiny model for a very long time, with validations and checkpoints, and checks that no resources leak.

    scripts/soak.py [--steps 100000] [--binary target/release/globalsplat] [--out runs/soak]

After each tenth of the steps, prints resident memory, open files, threads and the size of the run's checkpoints. Fails
if the last tenth has more files or threads than the first, or over 5 % more memory. Resumes where it was stopped.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

CONFIG = """
[model]
latents = 8
width = 16
rgb_width = 16
ray_width = 8
rounds = 1
self_attention_blocks = 1
heads = 2
candidates = 4

[data]
captures = ["{captures}"]
image_size = [16, 16]
context_views = 2
target_views = 1
window = [3, 220]
threads = 1
holdout = "every:3+1"

[curriculum]
final_stage = 2
boundaries = [1000, 2000]
transition = 500

[loss]
perceptual = "none"

[train]
steps = {steps}
batch = 1
checkpoint_every = 500
validate_every = 1000
log_images_every = 1000
"""


def state(process: int, run: Path) -> dict[str, float]:
    proc = Path(f"/proc/{process}")
    pages = int((proc / "statm").read_text().split()[1])
    folder = sum(file.stat().st_size for file in run.rglob("*") if file.is_file() and file.suffix == ".safetensors")
    return {
        "memory_mb": pages * 4096 / 1e6,
        "files": len(list((proc / "fd").iterdir())),
        "threads": len(list((proc / "task").iterdir())),
        "checkpoints_mb": folder / 1e6,
    }


def last_step(metrics: Path) -> int:
    """Returns the step of the last line, which is that of a training step or of a validation after it."""
    try:
        with metrics.open("rb") as file:
            file.seek(max(0, metrics.stat().st_size - 4096))
            lines = [line for line in file.read().split(b"\n")[1:] if b'"step":' in line]
    except FileNotFoundError:
        return 0
    return int(lines[-1].split(b'"step":')[1].split(b",")[0].rstrip(b"}")) if lines else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--binary", type=Path, default=Path("target/release/globalsplat"))
    parser.add_argument("--out", type=Path, default=Path("runs/soak"))
    options = parser.parse_args()
    captures, run, config = options.out / "captures", options.out / "run", options.out / "soak.toml"
    options.out.mkdir(parents=True, exist_ok=True)
    if not captures.exists():
        synth = ["synth", "--out", captures, "--scenes", "2", "--frames", "9", "--size", "40"]
        subprocess.run([options.binary, *synth], check=True, stdout=subprocess.DEVNULL)
    config.write_text(CONFIG.format(captures=captures.resolve(), steps=options.steps))

    train = subprocess.Popen([options.binary, "train", "--config", config, "--out", run], stdout=subprocess.DEVNULL)
    print(f"{'steps':>8} {'memory':>10} {'files':>6} {'threads':>8} {'checkpoints':>12} {'steps/s':>8}")
    tenths, start, first = [], time.monotonic(), None
    while train.poll() is None:
        time.sleep(0.05 if options.steps < 10_000 else 0.5)
        step = last_step(run / "metrics.jsonl")
        first = step if first is None else first
        if step * 10 // options.steps > len(tenths) and train.poll() is None:
            try:
                now = state(train.pid, run)
            except (FileNotFoundError, ProcessLookupError):
                break
            rate = (step - first) / (time.monotonic() - start)
            tenths.append(now)
            print(
                f"{step:>8} {now['memory_mb']:>7.1f} MB {now['files']:>6} {now['threads']:>8}"
                f" {now['checkpoints_mb']:>9.1f} MB {rate:>8.1f}",
                flush=True,
            )
    if train.wait() != 0:
        print("training failed", file=sys.stderr)
        return 1
    if len(tenths) < 2:
        print("too short to tell anything", file=sys.stderr)
        return 1
    begun, ended = tenths[0], tenths[-1]
    grown = [name for name in ("files", "threads") if ended[name] > begun[name]]
    grown += ["memory"] if ended["memory_mb"] > 1.05 * begun["memory_mb"] else []
    if grown:
        print(f"grown: {', '.join(grown)}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
