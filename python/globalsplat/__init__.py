"""GlobalSplat: posed photos to a compact 3D Gaussian splat, and a differentiable splat op for PyTorch on any CPU.

    >>> import globalsplat
    >>> splat = globalsplat.reconstruct("captures/room")
    >>> globalsplat.save_splat("room.ply", splat)

The parts are imported when they are first used, so that the command line program starts without importing PyTorch.
"""

import importlib
from typing import TYPE_CHECKING, Any

from ._requirements import check_requirements as _check_requirements

if TYPE_CHECKING:
    from ._models import Model as Model
    from ._models import load_model as load_model
    from ._native import Capture as Capture
    from ._native import simd_level as simd_level
    from ._rasterization import rasterization as rasterization
    from ._reconstruction import load_capture as load_capture
    from ._reconstruction import reconstruct as reconstruct
    from ._reconstruction import refine as refine
    from ._splats import Parameters as Parameters
    from ._splats import Splat as Splat
    from ._splats import load_splat as load_splat
    from ._splats import save_splat as save_splat

__version__ = "0.1.0"

_MODULES = {
    "Capture": "_reconstruction",
    "Model": "_models",
    "Parameters": "_splats",
    "Splat": "_splats",
    "load_capture": "_reconstruction",
    "load_model": "_models",
    "load_splat": "_splats",
    "rasterization": "_rasterization",
    "reconstruct": "_reconstruction",
    "refine": "_reconstruction",
    "save_splat": "_splats",
    "simd_level": "_ops",
}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    _check_requirements()  # before anything is loaded that was compiled for them
    value = getattr(importlib.import_module(f".{_MODULES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]
