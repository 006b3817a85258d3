"""Helpers for scripts that compare variants by training runs of one core each, one run per core in parallel."""

import json
import os
import subprocess
from pathlib import Path
from zlib import crc32

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAM = REPOSITORY / "target/release/globalsplat"
# Arguments of `refine` at the size of the paper's images: photos are cropped and resized.
SMALL = ["--size", "256x256"]


def environment(**more):
    """Returns the environment variables of a process that uses one core."""
    return dict(os.environ, OMP_NUM_THREADS="1", **more)


def core_seconds(command, **variables):
    """Runs a command and returns its standard output and its CPU time in seconds."""
    process = subprocess.Popen(command, env=environment(**variables), stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    told = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status != 0:
        raise RuntimeError(f"{' '.join(map(str, command))} failed")
    return told, usage.ru_utime + usage.ru_stime


def train(run, config, settings, **variables):
    """Trains a run and returns its JSON result with its CPU time (`core_seconds`), cached in `result.json`."""
    result = run / "result.json"
    if not result.is_file():
        command = [PROGRAM, "train", "--config", config, "--out", run, "--json"]
        for setting in settings:
            command += ["--set", setting]
        told, seconds = core_seconds(command, **variables)
        told = json.loads(told)
        if "held_out" not in told:
            raise RuntimeError(f"{run}: nothing was held out")
        partial = result.with_suffix(".partial")
        partial.write_text(json.dumps(told | {"core_seconds": seconds}))
        partial.rename(result)
    return json.loads(result.read_text())


def told(*command):
    """Runs a command of the program and returns its JSON output."""
    return json.loads(subprocess.run([PROGRAM, *command, "--json"], stdout=subprocess.PIPE, check=True).stdout)


def identity(command):
    """Returns a command's arguments, and a checksum of the files that they refer to, except the argument of --out."""
    inputs = [
        Path(str(argument)) for before, argument in zip(("", *command), command, strict=False) if before != "--out"
    ]
    checksum = 0
    for file in (file for path in inputs for file in sorted([path, *path.rglob("*")]) if file.is_file()):
        with file.open("rb") as opened:
            while block := opened.read(1 << 20):
                checksum = crc32(block, checksum)
    return [*map(str, command), f"{checksum:08x}"]


def told_once(file, *command):
    """Returns the JSON output of a command, cached in `file` for the same arguments and inputs."""
    of = identity(command)
    kept = json.loads(file.read_text()) if file.is_file() else {}
    if kept.get("of") != of:
        kept = {"of": of, "told": told(*command)}
        partial = file.with_suffix(".partial")
        partial.write_text(json.dumps(kept))
        partial.rename(file)
    return kept["told"]


def refined(file, folder, holdout, seconds, *more):
    """Refines with further arguments `more`; returns the JSON output, held-out scores included.

    The output is cached in `file`, and the splat is beside it.
    """
    command = ["refine", "--scene", folder, "--holdout", holdout, *more]
    return told_once(file, *command, "--seconds", str(seconds), "--out", file.with_suffix(".ply"))


def row(*cells):
    """Prints a row of a Markdown table."""
    print("|", " | ".join(cells), "|", flush=True)
