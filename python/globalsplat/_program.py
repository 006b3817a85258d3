"""The command line program, which uses the libtorch of the installed PyTorch."""

import os
import sys
from pathlib import Path

from ._requirements import check_requirements, torch_folder


def main() -> None:
    """Replaces this process with the program `globalsplat`, with the same arguments."""
    try:
        check_requirements()
        libraries = torch_folder() / "lib"
    except ImportError as error:
        sys.exit(f"globalsplat: {error}")
    package = Path(__file__).resolve().parent
    # The program finds a PyTorch beside this package by itself. In an environment on top of another one, PyTorch may lie elsewhere.
    if libraries.resolve() != package.parent / "torch" / "lib":
        variable = "DYLD_LIBRARY_PATH" if sys.platform == "darwin" else "LD_LIBRARY_PATH"
        others = os.environ.get(variable)
        os.environ[variable] = f"{libraries}:{others}" if others else str(libraries)
    program = package / "bin" / "globalsplat"
    os.execv(program, [sys.argv[0], *sys.argv[1:]])
