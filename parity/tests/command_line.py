"""Runs the program in tests."""

import json
import subprocess
from pathlib import Path

RELEASE = Path(__file__).resolve().parents[2] / "target/release"


def run(*arguments, **environment):
    command = [str(RELEASE / "globalsplat"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, **environment)


def succeed(*arguments, **environment):
    """Returns the JSON that the program prints."""
    done = run(*arguments, "--json", **environment)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def refuse(*arguments):
    """Returns the one line of the error."""
    done = run(*arguments)
    assert done.returncode == 2 and not done.stdout, (done.returncode, done.stderr)
    assert done.stderr.startswith("globalsplat: ") and done.stderr.count("\n") == 1, done.stderr
    return done.stderr


def make_rooms(folder, scenes, frames, size):
    """Writes the captures room_000, … of synthetic rooms to `folder`, each with `frames` photos of `size` × `size` pixels."""
    subprocess.run([RELEASE / "examples/make_rooms", folder, *map(str, (scenes, frames, size))], check=True)
