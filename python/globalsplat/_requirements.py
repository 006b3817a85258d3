"""What the compiled parts of this package need, checked before any of them is loaded."""

import importlib.metadata
import importlib.util
import sysconfig
from pathlib import Path

#: Versions of PyTorch that this package was compiled for: libtorch's C++ interface changes with each.
REQUIRED = "2.11"


def torch_folder() -> Path:
    """Returns the folder of the installed PyTorch without importing it.

    Raises:
        ImportError: if PyTorch isn't installed, or in another version, or if this package was installed from a wheel for another system or
            processor.
    """
    _check_platform()
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
    """Compares this Python's platform with that in the tags of the wheel, as cp310-abi3-manylinux_2_28_x86_64."""
    try:
        wheel = importlib.metadata.distribution("globalsplat").read_text("WHEEL") or ""
    except importlib.metadata.PackageNotFoundError:
        return  # not installed, but a folder on the path
    platforms = [line.rpartition("-")[2] for line in wheel.splitlines() if line.startswith("Tag:")]
    system, *_, machine = sysconfig.get_platform().split("-")
    if platforms and not any(system in platform and platform.endswith(machine) for platform in platforms):
        raise ImportError(
            f"globalsplat was compiled for {platforms[-1]}, and this Python is for {sysconfig.get_platform()}: "
            "pip install --force-reinstall globalsplat"
        )
