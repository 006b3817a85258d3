#!/usr/bin/env python3
"""Measures the wall-clock time of `globalsplat refine`, from start to end for several budgets, and from Ctrl-C to end.

    .venv/bin/python scripts/refine_time.py --capture DIR [--capture …] [--seconds 3 10 60] [--stop 0.3 1 2 5]
        [--out OUT]

Prints a Markdown table. Run nothing else meanwhile.
"""

import argparse
import json
import signal
import subprocess
import time
from pathlib import Path

from core_runs import PROGRAM, row


def timed(scene, out, seconds, stop=None, *more):
    """Returns wall-clock seconds (from Ctrl-C, if stopped), the JSON output, if a splat exists, and standard error."""
    out.unlink(missing_ok=True)
    command = [PROGRAM, "refine", "--scene", scene, "--out", out, "--seconds", str(seconds), "--json", *more]
    begun = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    if stop is not None:
        time.sleep(stop)
        begun = time.monotonic()
        process.send_signal(signal.SIGINT)
    told, complaints = process.communicate()
    return time.monotonic() - begun, json.loads(told or "{}"), out.is_file(), complaints.strip()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", action="append", required=True, metavar="DIR")
    parser.add_argument("--seconds", type=float, nargs="*", default=[3, 10, 60])
    parser.add_argument("--stop", type=float, nargs="*", default=[0.3, 1, 2, 5])
    parser.add_argument("--out", type=Path, default=Path("runs/refine_time"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    row("capture", "asked for", "wall clock", "steps", "standard error")
    row(*["---"] * 5)
    for capture in arguments.capture:
        out = arguments.out / f"{Path(capture).name}.ply"
        for seconds in arguments.seconds:
            for more in ([], ["--holdout", "every:8"]):
                took, told, _, complaints = timed(capture, out, seconds, None, *more)
                name = f"{Path(capture).name}{', views held out' if more else ''}"
                row(name, f"{seconds:g} s", f"{took:.2f} s", str(told.get("steps")), complaints)
        for stop in arguments.stop:
            took, told, is_there, complaints = timed(capture, out, 600, stop)
            result = str(told.get("steps")) if is_there else "no splat"
            row(Path(capture).name, f"Ctrl-C after {stop:g} s", f"{took:.2f} s", result, complaints)


if __name__ == "__main__":
    main()
