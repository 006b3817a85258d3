"""Captures for tests."""

import subprocess
from pathlib import Path

PROGRAM = Path(__file__).resolve().parents[2] / "target/release/examples/make_rooms"


def make_rooms(folder, scenes, frames, size):
    """Writes the captures room_000, … of synthetic rooms to `folder`, each with `frames` photos of `size` × `size` pixels."""
    subprocess.run([PROGRAM, folder, *map(str, (scenes, frames, size))], check=True)
