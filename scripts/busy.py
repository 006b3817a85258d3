#!/usr/bin/env python3
"""Measures the training speed of configs/first_light.toml, alone and beside busy processes.

    scripts/busy.py [--steps 60] [--busy 0 1 2] [--binary target/release/globalsplat …]

Each busy process is a loop that never sleeps. Several binaries are measured in turn. Prints a Markdown table of steps
per second, absolute and relative to the same binary's first measurement.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path


def processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return "an unknown processor"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--binary", type=Path, nargs="+", default=[Path("target/release/globalsplat")])
    options = parser.parse_args()
    rates = {}
    with tempfile.TemporaryDirectory() as folder:
        synth = ["synth", "--out", folder, "--scenes", "2", "--frames", "12", "--size", "256"]
        subprocess.run([options.binary[0], *synth], check=True, stdout=subprocess.DEVNULL)
        bench = ["bench", "train", "--config", "configs/first_light.toml", "--batch", "2", "--json"]
        bench += ["--steps", str(options.steps), "--set", f'data.captures=["{folder}"]']
        for count in options.busy:
            for binary in options.binary:
                busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
                try:
                    done = subprocess.run([binary, *bench], check=True, capture_output=True)
                finally:
                    for process in busy:
                        process.kill()
                        process.wait()
                rates[binary, count] = 1e3 / json.loads(done.stdout)["milliseconds"]["median"]
                print(f"{binary}, beside {count}: {rates[binary, count]:.2f} steps/s", file=sys.stderr, flush=True)
    print(f"{os.cpu_count()} cores, {processor()}\n")
    print("| program | busy processes | steps a second | of its first |\n|---|---|---|---|")
    for (binary, count), rate in rates.items():
        print(f"| {binary} | {count} | {rate:.2f} | {100 * rate / rates[binary, options.busy[0]]:.0f} % |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
