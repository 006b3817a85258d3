"""The installed PyTorch, which is checked before anything is loaded that was compiled for one version of it."""

import importlib.metadata
import importlib.util
from pathlib import Path

#: Versions of PyTorch that this package was compiled for: libtorch's C++ interface changes with each.
REQUIRED = "2.11"


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
