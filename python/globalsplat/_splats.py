"""Splat files as dictionaries."""

import os
import warnings
from collections.abc import Mapping
from typing import Any, Literal, TypedDict, overload

import numpy as np
import numpy.typing as npt
import torch

from . import _native
from ._checks import expect, expect_shape, select_harmonics

Array = Any
"""A NumPy array or a tensor."""


#: Natural logarithm of the largest scale that splat files may have.
MAX_LOG_SCALE = 88.0


class _Origin(TypedDict, total=False):
    origin: Array


class Splat(_Origin):
    """Gaussians, as arguments of :func:`rasterization` of the same names.

    With an :attr:`origin`, :math:`(3,)` in float64, :attr:`means` are relative to it: float32 would round world coordinates far away.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    colors: Array
    sh_degree: int
    eps2d: float
    rasterize_mode: Literal["classic", "antialiased"]


class Parameters(_Origin):
    """Gaussians before activation, as 3DGS and gsplat optimize and store them.

    :attr:`scales` are logarithms and :attr:`opacities` logits. :attr:`sh0` has the first spherical harmonic, :math:`(N, 1, 3)`, and
    :attr:`shN` the others, :math:`(N, K - 1, 3)`. The :attr:`origin` is that of :class:`Splat`.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh0: Array
    shN: Array
    rasterize_mode: Literal["classic", "antialiased"]


@overload
def load_splat(path: str | os.PathLike[str], activated: Literal[True] = True) -> Splat: ...
@overload
def load_splat(path: str | os.PathLike[str], activated: Literal[False]) -> Parameters: ...
def load_splat(path: str | os.PathLike[str], activated: bool = True) -> Splat | Parameters:
    """Reads a splat file of any format that the program reads, such as .ply, .compressed.ply, .sog, .spz, .splat, .ksplat or .glb.

    Args:
        path (str or PathLike): the file.
        activated (bool): returns arguments of :func:`rasterization` if ``True``, and the parameters that the file holds, bit for bit,
            if ``False``.

    Returns:
        A dictionary of NumPy arrays in float32, and with ``origin`` in float64 if the file has coordinates relative to one. Warnings of
        the reader are given as :class:`UserWarning`.

    Raises:
        ValueError: if the file isn't a valid splat.
        OSError: if it can't be read.

    Examples::

        >>> splat = globalsplat.load_splat("room.ply")
        >>> tensors = {name: torch.as_tensor(value) if hasattr(value, "shape") else value for name, value in splat.items()}
        >>> image, alpha, meta = globalsplat.rasterization(**tensors, viewmats=viewmats, Ks=Ks, width=640, height=480)
    """
    raw, lines = _native.read_splat(path)
    warn(lines)
    if not activated:
        sh = raw["sh"]
        return {
            "means": raw["means"],
            "quats": raw["quats"],
            "scales": raw["log_scales"],
            "opacities": raw["opacity_logits"],
            "sh0": sh[:, :1],
            "shN": sh[:, 1:],
            "rasterize_mode": _mode(raw),
            **_origin(raw),
        }
    return to_splat(raw)


def save_splat(
    path: str | os.PathLike[str],
    splat: Mapping[str, Any] | torch.nn.ParameterDict,
    activated: bool = True,
    *,
    capture: _native.Capture | None = None,
) -> None:
    """Writes a splat file in the format that the extension names. The file is replaced in one step.

    Args:
        path (str or PathLike): the file.
        splat (dict or nn.ParameterDict): arrays or tensors of N Gaussians with the keys of :class:`Splat`, of which
            ``sh_degree``, ``eps2d``, ``rasterize_mode`` and ``origin`` may be absent, or those of :class:`Parameters` if
            :attr:`activated` is ``False``. Spherical harmonics :math:`(N, K, 3)` are needed, not colors; those above ``sh_degree``
            aren't written. An ``origin`` is written to a file beside the splat, ``room.ply.origin.json`` for ``room.ply``.
        activated (bool): as in :func:`load_splat`.
        capture (Capture, optional): the photos' cameras. A format with fewer spherical harmonics than the splat, such as .splat, gets
            the colors that these cameras see.

    Raises:
        ValueError: if shapes don't fit, a value isn't finite, or the extension is unknown.
        OSError: if the file can't be written.

    Examples::

        >>> globalsplat.save_splat("room.spz", splat)
        >>> globalsplat.save_splat("trained.ply", params, activated=False)  # an nn.ParameterDict as in gsplat's trainer
    """
    _native.write_splat(path, from_splat(splat, activated), capture)


def to_splat(raw: Mapping[str, Any]) -> Splat:
    """Converts what the native module returns to arguments of rasterization()."""
    sh = raw["sh"]
    return {
        "means": raw["means"],
        "quats": raw["quats"],
        "scales": np.exp(raw["log_scales"].astype(np.float64)).astype(np.float32),
        "opacities": (1.0 / (1.0 + np.exp(-raw["opacity_logits"].astype(np.float64)))).astype(np.float32),
        "colors": sh,
        "sh_degree": round(sh.shape[1] ** 0.5) - 1,
        "eps2d": raw["eps2d"],
        "rasterize_mode": _mode(raw),
        **_origin(raw),
    }


def _origin(raw: Mapping[str, Any]) -> _Origin:
    return {"origin": raw["origin"]} if raw["origin"].any() else {}


def _mode(raw: Mapping[str, Any]) -> Literal["classic", "antialiased"]:
    return "antialiased" if raw["antialiased"] else "classic"


def from_splat(splat: Mapping[str, Any] | torch.nn.ParameterDict, activated: bool = True) -> dict[str, Any]:
    """Converts a splat to what the native module takes."""
    names = ["means", "quats", "scales", "opacities", *(["colors"] if activated else ["sh0", "shN"])]
    missing = [name for name in names if name not in splat]
    if missing:
        raise ValueError(f"the splat has no {', '.join(missing)}, expected {', '.join(names)}")
    values = {name: _to_array(name, splat[name]) for name in names}
    means, scales, opacities = values["means"], values["scales"], values["opacities"]
    count = len(means) if means.ndim else 0
    if opacities.shape == (count, 1):  # as in gsplat's files
        opacities = opacities[:, 0]
    expect_shape("means", means, count, 3)
    expect_shape("quats", values["quats"], count, 4)
    expect_shape("scales", scales, count, 3)
    expect_shape("opacities", opacities, count)
    mode = splat.get("rasterize_mode", "classic")
    expect("rasterize_mode", repr(mode), mode in ("classic", "antialiased"), "classic or antialiased")
    largest = (np.exp(MAX_LOG_SCALE), 1.0) if activated else (MAX_LOG_SCALE, np.inf)
    for name, array, most in zip(("scales", "opacities"), (scales, opacities), largest, strict=True):
        least = 0.0 if activated else -np.inf
        invalid = array[(array < least) | (array > most)]
        if len(invalid) > 0:
            raise ValueError(f"{name} has {invalid[0]:g}, expected {least:g} to {most:g}")
    if activated:
        sh = values["colors"]
        with np.errstate(divide="ignore"):
            scales = np.log(scales)
            opacities = np.log(opacities) - np.log1p(-opacities)
    else:
        sh = np.concatenate([values["sh0"], values["shN"]], 1)
    if sh.ndim != 3 or (len(sh), sh.shape[2]) != (count, 3):
        raise ValueError(f"colors has shape {list(sh.shape)}, expected spherical harmonics [{count}, K, 3]")
    degree = splat.get("sh_degree")
    if degree is not None:
        sh = select_harmonics(sh, degree)
    origin = _to_array("origin", splat.get("origin", np.zeros(3)))
    expect_shape("origin", origin, 3)

    def contiguous(array: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
        return np.ascontiguousarray(array, np.float32)

    return {
        "means": contiguous(means),
        "quats": contiguous(values["quats"]),
        "log_scales": contiguous(scales),
        "opacity_logits": contiguous(opacities),
        "sh": contiguous(sh),
        "antialiased": mode == "antialiased",
        "origin": origin,
    }


def _to_array(name: str, value: Array) -> npt.NDArray[np.float64]:
    """Returns a float64 array of an array or tensor, whose numbers float32 can hold. Only logarithms and logits may be infinite."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().double().numpy()
    array = np.asarray(value, np.float64)
    most = np.inf if name in ("scales", "opacities") else np.finfo(np.float32).max
    if not (np.abs(array) <= most).all():
        raise ValueError(f"{name} has values that aren't finite in float32")
    return array


def warn(lines: list[str]) -> None:
    """Gives the warnings of the native module to the caller of this package's function."""
    for line in lines:
        warnings.warn(line, stacklevel=3)
