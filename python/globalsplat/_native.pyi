"""Functions of the native module, which the other modules document."""

import os
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

Path = str | os.PathLike[str]
Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]

class Capture:
    """Photos with known cameras. :func:`load_capture` opens it."""

    @property
    def name(self) -> str:
        """Name of the capture."""
    @property
    def names(self) -> list[str]:
        """Names of the photos."""
    @property
    def warnings(self) -> list[str]:
        """Messages about what was left out or changed when the capture was opened."""
    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Width and height of every photo in pixels."""
    @property
    def viewmats(self) -> Doubles:
        """World-to-camera matrices, with x right, y down and z forward. :math:`(V, 4, 4)`"""
    @property
    def Ks(self) -> Doubles:
        """Intrinsic matrices in pixels. :math:`(V, 3, 3)`"""
    def points(self) -> tuple[Doubles, Floats]:
        """Returns the points of a COLMAP reconstruction and their colors in [0, 1], :math:`(P, 3)` each; none if there aren't any."""
    def image(self, index: int) -> npt.NDArray[np.uint8]:
        """Reads a photo without its lens distortion. :math:`(H, W, 3)`"""
    def __len__(self) -> int: ...

def open_capture(path: Path, masks: Path | None = None) -> Capture: ...
def capture_from_images(images: npt.NDArray[np.uint8], viewmats: Doubles, intrinsics: Doubles) -> Capture: ...
def read_splat(path: Path) -> tuple[dict[str, Any], list[str]]: ...
def write_splat(path: Path, splat: Mapping[str, Any], capture: Capture | None) -> None: ...
def reconstruct(
    capture: Capture, weights: Path | None, views: int | None, cuda: int | None
) -> tuple[dict[str, Any], list[str]]: ...
def refine(
    capture: Capture,
    initial: Mapping[str, Any] | None,
    options: str,
    cuda: int | None,
    progress: Callable[[int, float | None], object] | None,
) -> tuple[dict[str, Any], list[str]]: ...
def read_model(weights: Path | None) -> tuple[dict[str, Floats], str, int, float]: ...
def simd_level() -> str:
    """Returns the instruction set of the rasterizer's CPU kernels: avx512, avx2, neon or portable."""
