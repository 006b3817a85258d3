"""What the compiled parts of this package need, checked before any of them is loaded."""

import functools
import importlib.metadata
import importlib.util
import platform
import sys
from pathlib import Path

#: Versions of PyTorch that this package was compiled for: libtorch's C++ interface changes with each.
REQUIRED = "2.11"


@functools.cache
def check_requirements() -> None:
    """Checks the system, the processor and PyTorch.

    Raises:
        ImportError: if this package was installed from a wheel for another system or processor, or see :func:`torch_folder`.
    """
    _check_platform()
    torch_folder()


@functools.cache
def torch_folder() -> Path:
    """Returns the folder of the installed PyTorch without importing it.

    Raises:
        ImportError: if PyTorch isn't installed, or in another version.
    """
    spec = importlib.util.find_spec("torch")
    if spec is None or spec.origin is None:
        raise ImportError(
            f"globalsplat needs PyTorch {REQUIRED}, which isn't installed: pip install 'torch=={REQUIRED}.*'"
        )
    version = importlib.metadata.version("torch")
    if version.split(".")[:2] != REQUIRED.split("."):
        raise ImportError(
            f"globalsplat was compiled for PyTorch {REQUIRED}, and {version} is installed: pip install 'torch=={REQUIRED}.*'"
        )
    return Path(spec.origin).parent


def _check_platform() -> None:
    """Compares this system and processor with those in the tag of the installed wheel, as cp310-abi3-manylinux_2_28_x86_64."""
    try:
        wheel = importlib.metadata.distribution("globalsplat").read_text("WHEEL") or ""
    except importlib.metadata.PackageNotFoundError:
        return  # not installed, but a folder on the path
    platforms = [line.rpartition("-")[2] for line in wheel.splitlines() if line.startswith("Tag:")]
    system = {"darwin": "macosx"}.get(sys.platform, sys.platform)
    processor = platform.machine()
    if platforms and not any(system in tag and tag.endswith(processor) for tag in platforms):
        raise ImportError(
            f"globalsplat was compiled for {platforms[-1]}, and this is {system} on {processor}: install the wheel for it"
        )
