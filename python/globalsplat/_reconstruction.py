"""Captures, and splats from them."""

import json
import os
from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from . import _native
from ._checks import expect, expect_shape
from ._native import Capture
from ._splats import Splat, from_splat, to_splat, warn

Path = str | os.PathLike[str]


def load_capture(path: Path, masks: Path | None = None) -> Capture:
    """Opens photos with known cameras: a COLMAP or nerfstudio folder, a transforms.json, a RealEstate10K chunk and others.

    Photos are read when they are needed.

    Args:
        path (str or PathLike): the folder or file. The program's documentation lists the formats.
        masks (str or PathLike, optional): folder of masks that are named like the photos; black pixels don't count.

    Raises:
        ValueError: if the capture isn't valid.
        OSError: if it can't be read.

    Examples::

        >>> capture = globalsplat.load_capture("captures/room")
        >>> image = torch.from_numpy(capture.image(0))  # [H, W, 3], uint8
        >>> viewmats, Ks = torch.from_numpy(capture.viewmats), torch.from_numpy(capture.Ks)
    """
    capture = _native.open_capture(path, masks)
    warn(capture.warnings)
    return capture


def reconstruct(
    capture: Capture | Path | Tensor,
    viewmats: Tensor | None = None,
    Ks: Tensor | None = None,
    *,
    weights: Path | None = None,
    views: int | None = None,
    device: str | torch.device = "cpu",
) -> Splat:
    """Reconstructs a splat from posed photos in one forward pass of the network, as the program's command ``reconstruct`` does.

    Args:
        capture (Capture, str, PathLike or Tensor): a capture or its path, or images :math:`(V, H, W, 3)` with uint8 values, or floats
            in [0, 1].
        viewmats (Tensor, optional): world-to-camera matrices of the images. :math:`(V, 4, 4)`
        Ks (Tensor, optional): intrinsic matrices of the images in pixels. :math:`(V, 3, 3)`
        weights (str or PathLike, optional): weights of the network; by default those that come with this package.
        views (int, optional): maximum number of photos, spread along the camera path; by default the number that the weights were
            configured for.
        device (str or torch.device): device of the network.

    Returns:
        A dictionary of tensors on :attr:`device`, in the capture's world: arguments of :func:`rasterization`.

    Examples::

        >>> splat = globalsplat.reconstruct("captures/room")
        >>> image, alpha, meta = globalsplat.rasterization(**splat, viewmats=viewmats, Ks=Ks, width=640, height=480)
    """
    raw, lines = _native.reconstruct(_to_capture(capture, viewmats, Ks), weights, views, _cuda_index(device))
    warn(lines)
    return _to_tensors(raw, device)


def refine(
    capture: Capture | Path,
    splat: Mapping[str, Any] | None = None,
    *,
    seconds: float = 60.0,
    steps: int | None = None,
    gaussians: int | None = None,
    views: int | None = None,
    size: int | None = None,
    seed: int = 0,
    antialiased: bool = False,
    correct_poses: bool = False,
    settings: Mapping[str, Any] | None = None,
    device: str | torch.device = "cpu",
    progress: Callable[[int, float | None], object] | None = None,
) -> Splat:
    """Optimizes a splat on the photos of its scene, or creates one from the photos alone, as the program's command ``refine`` does.

    Args:
        capture (Capture, str or PathLike): the capture or its path.
        splat (dict, optional): the initial splat, as :func:`reconstruct` or :func:`load_splat` returns it. Without it, Gaussians start
            where the depths of several photos agree.
        seconds (float): time to take.
        steps (int, optional): number of steps, instead of a time: the same steps and seed give the same bits.
        gaussians (int, optional): number of Gaussians without :attr:`splat`; by default one that suits the time and the photos.
        views (int, optional): maximum number of photos, spread along the camera path.
        size (int, optional): longer side in pixels to which larger photos are downscaled.
        seed (int): seed of the random numbers.
        antialiased (bool): optimizes for antialiased rendering.
        correct_poses (bool): also optimizes the poses of the cameras.
        settings (dict, optional): settings of the method, which docs/configuration.md lists.
        device (str or torch.device): device of the optimization.
        progress (callable, optional): is called with the number of steps done and the PSNR of held-out views, or ``None``. An exception
            that it raises ends the optimization.

    Returns:
        A dictionary of tensors on :attr:`device`, as :func:`reconstruct` returns it.

    Examples::

        >>> splat = globalsplat.refine("captures/room", seconds=30)
        >>> globalsplat.save_splat("room.ply", splat)
    """
    for name, value in (("steps", steps), ("gaussians", gaussians), ("views", views), ("size", size)):
        expect(name, value, value is None or value >= 1, "1 or more")
    expect("seed", seed, seed >= 0, "0 or more")
    options = {
        "seconds": seconds,
        "steps": steps,
        "gaussians": gaussians,
        "views": views,
        "size": None if size is None else str(size),
        "seed": seed,
        "antialiased": antialiased,
        "correct_poses": correct_poses,
        "set": [f"{name}={json.dumps(value)}" for name, value in (settings or {}).items()],
    }
    initial = None if splat is None else from_splat(splat)
    raw, lines = _native.refine(_to_capture(capture), initial, json.dumps(options), _cuda_index(device), progress)
    warn(lines)
    return _to_tensors(raw, device)


def _to_capture(capture: Capture | Path | Tensor, viewmats: Tensor | None = None, Ks: Tensor | None = None) -> Capture:
    if isinstance(capture, Tensor):
        if viewmats is None or Ks is None:
            raise ValueError("images need viewmats and Ks")
        images = capture.detach().cpu()
        if images.is_floating_point():
            # Resampling oversteps the range by less than half of it.
            invalid = images[~((images > -0.5) & (images < 1.5))]
            if len(invalid) > 0:
                raise ValueError(f"images have {invalid[0]:g}, expected floats from 0 to 1, or uint8")
            images = (images.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
        if images.dtype != torch.uint8 or images.dim() != 4 or images.shape[3] != 3:
            found = f"{images.dtype} of shape {list(images.shape)}"
            raise ValueError(f"images are {found}, expected uint8 or floats [V, H, W, 3]")
        expect_shape("viewmats", viewmats, len(images), 4, 4)
        expect_shape("Ks", Ks, len(images), 3, 3)
        if Ks[:, 0, 1].any():
            raise ValueError("Ks have a skew, expected 0 in row 0, column 1")
        cameras = [np.ascontiguousarray(matrices.detach().cpu().double().numpy()) for matrices in (viewmats, Ks)]
        return _native.capture_from_images(np.ascontiguousarray(images.numpy()), *cameras)
    if viewmats is not None or Ks is not None:
        raise ValueError("viewmats and Ks belong to images: a capture has its own")
    return capture if isinstance(capture, Capture) else load_capture(capture)


def _cuda_index(device: str | torch.device) -> int | None:
    device = torch.device(device)
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f"device is {device}, expected cpu or cuda")
    if device.type == "cpu":
        return None
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    index = device.index if device.index is not None else 0
    if index >= count:
        raise ValueError(f"device is {device}, and PyTorch finds {count} CUDA devices")
    return index


def _to_tensors(raw: Mapping[str, Any], device: str | torch.device) -> Splat:
    splat = to_splat(raw)
    tensors = {key: torch.from_numpy(value).to(device) for key, value in splat.items() if isinstance(value, np.ndarray)}
    return cast(Splat, splat | tensors)
