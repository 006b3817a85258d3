"""The program, and Markdown tables of what it prints, for scripts that measure it."""

import json
import statistics
import subprocess
from pathlib import Path
from zlib import crc32

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAM = REPOSITORY / "target/release/globalsplat"


def run(*command, **options):
    """Runs a command of the program and returns its JSON output."""
    done = subprocess.run([PROGRAM, *map(str, command), "--json"], stdout=subprocess.PIPE, check=True, **options)
    return json.loads(done.stdout)


def run_once(file, *command, **options):
    """Returns the JSON output of a command, which is kept in `file` and not computed again."""
    if not file.is_file():
        partial = file.with_suffix(".partial")
        partial.write_text(json.dumps(run(*command, **options)))
        partial.rename(file)
    return json.loads(file.read_text())


def digest(*settings):
    """Returns a checksum of settings, for the names of files whose content depends on them."""
    return f"{crc32(repr(settings).encode()):08x}"


def with_deviation(values):
    """Formats the mean of `values` with its standard deviation."""
    spread = f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):.2f}{spread}"


def row(*cells):
    """Prints a row of a Markdown table."""
    print("|", " | ".join(map(str, cells)), "|", flush=True)
