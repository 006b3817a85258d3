"""The program, and Markdown tables of what it prints, for scripts that measure it."""

import json
import subprocess
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAM = REPOSITORY / "target/release/globalsplat"


def run(*command):
    """Runs a command of the program and returns its JSON output."""
    return json.loads(subprocess.run([PROGRAM, *command, "--json"], stdout=subprocess.PIPE, check=True).stdout)


def row(*cells):
    """Prints a row of a Markdown table."""
    print("|", " | ".join(cells), "|", flush=True)
