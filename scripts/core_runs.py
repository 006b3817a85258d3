"""Training runs of one core each, as many side by side as there are cores: what scripts that compare variants share."""

import json
import os
import subprocess
from pathlib import Path
from zlib import crc32

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAM = REPOSITORY / "target/release/globalsplat"


def environment(**more):
    """For a process that keeps to one core."""
    return dict(os.environ, OMP_NUM_THREADS="1", **more)


def core_seconds(command, **variables):
    """What a command of the program told, and the seconds for which it kept the core busy."""
    process = subprocess.Popen(command, env=environment(**variables), stdout=subprocess.PIPE, text=True)
    told = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status != 0:
        raise RuntimeError(f"{' '.join(map(str, command))} failed")
    return told, usage.ru_utime + usage.ru_stime


def train(run, config, settings, **variables):
    """What a run told at its end, which its folder keeps, and the seconds for which its process kept the core busy."""
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
    """What a command of the program told."""
    return json.loads(subprocess.run([PROGRAM, *command, "--json"], stdout=subprocess.PIPE, check=True).stdout)


def files_of(path):
    """The files that a path stands for: its own, those of a folder, those of weights in shards."""
    index = path if path.name.endswith(".safetensors.index.json") else path.with_name(path.name + ".index.json")
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.is_file())
    if index.is_file() and (path == index or not path.exists()):
        return [index, *sorted({index.with_name(name) for name in json.loads(index.read_text())["weight_map"].values()})]
    return [path] if path.is_file() else []


def identity(command):
    """A command's arguments, and a checksum of the files that those which are paths stand for, but for what it writes."""
    inputs = [Path(str(argument)) for before, argument in zip(("", *command), command) if before != "--out"]
    checksum = 0
    for file in (file for path in inputs for file in files_of(path)):
        with file.open("rb") as opened:
            while block := opened.read(1 << 20):
                checksum = crc32(block, checksum)
    return [*map(str, command), f"{checksum:08x}"]


def told_once(file, *command):
    """The same, which `file` keeps: it isn't run again for the same arguments and inputs."""
    of = identity(command)
    kept = json.loads(file.read_text()) if file.is_file() else {}
    if kept.get("of") != of:
        kept = {"of": of, "told": told(*command)}
        partial = file.with_suffix(".partial")
        partial.write_text(json.dumps(kept))
        partial.rename(file)
    return kept["told"]


def row(*cells):
    """Of a Markdown table."""
    print("|", " | ".join(cells), "|", flush=True)
