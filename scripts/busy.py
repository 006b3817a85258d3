#!/usr/bin/env python3
"""Trains as `make demo` does, alone and beside other work, and tells what that costs.

    scripts/busy.py [--steps 60] [--busy 0 1 2] [--wait default passive 500] [--binary target/release/globalsplat]

Each busy process is a loop that never sleeps. --wait says how OpenMP's threads wait for each other: by `default` they spin for
milliseconds, `passive` ones sleep at once, and with a number they look so often before they sleep. Prints Markdown: steps a
second, and the share of the fastest.
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
    parser.add_argument("--wait", nargs="+", default=["default"])
    parser.add_argument("--binary", type=Path, default=Path("target/release/globalsplat"))
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        synth = ["synth", "--out", folder, "--scenes", "2", "--frames", "12"]
        subprocess.run([options.binary, *synth], check=True, stdout=subprocess.DEVNULL)
        bench = ["bench", "train", "--config", "configs/first_light.toml", "--batch", "2", "--json"]
        bench += ["--steps", str(options.steps), "--set", f'data.captures=["{folder}"]']
        for wait in options.wait:
            environment = dict(os.environ)
            if wait.isdigit():
                environment["GOMP_SPINCOUNT"] = wait
            elif wait == "passive":
                environment["OMP_WAIT_POLICY"] = wait
            for count in options.busy:
                busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
                try:
                    done = subprocess.run([options.binary, *bench], env=environment, check=True, capture_output=True)
                finally:
                    for process in busy:
                        process.kill()
                        process.wait()
                rows.append((wait, count, 1e3 / json.loads(done.stdout)["milliseconds"]["median"]))
                print(f"{wait}, beside {count}: {rows[-1][2]:.2f} steps/s", file=sys.stderr, flush=True)
    fastest = max(rate for _, _, rate in rows)
    print(f"{os.cpu_count()} cores, {processor()}\n")
    print("| threads wait | busy processes | steps a second | of the fastest |\n|---|---|---|---|")
    for wait, count, rate in rows:
        print(f"| {wait} | {count} | {rate:.2f} | {100 * rate / fastest:.0f} % |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
