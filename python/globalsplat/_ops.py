"""The splat op for PyTorch: gradients and fake tensors of torch.ops.globalsplat, which the native module defines."""

from typing import Any, NoReturn

import torch
from torch import Tensor

from ._native import simd_level as simd_level  # the native module defines the ops

# Numbers of arguments of every op: tensors, and settings.
TENSORS, SETTINGS = 7, 7


def result_dtype(means: Tensor) -> torch.dtype:
    """Returns the type in which Gaussians are rendered."""
    return torch.float64 if means.dtype == torch.float64 else torch.float32


def _splat_fake(means: Tensor, *inputs: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    viewmats, (width, height) = inputs[4], inputs[6:8]
    rgb = means.new_empty((*viewmats.shape[:2], 3, height, width), dtype=result_dtype(means))
    alpha, depth = (rgb.new_empty((*viewmats.shape[:2], height, width)) for _ in range(2))
    return rgb, alpha, depth, torch.empty(1, dtype=torch.int64, device="cpu")


def _splat_backward_fake(*inputs: Any) -> tuple[Tensor, ...]:
    tensors, (has_viewmats_grad, has_means2d_grad) = inputs[:TENSORS], inputs[-2:]
    means, viewmats = tensors[0], tensors[5]
    dtype = result_dtype(means)
    gradients = [means.new_empty(tensor.shape, dtype=dtype) for tensor in tensors[:6]]
    if not has_viewmats_grad:
        gradients[5] = means.new_empty(0, dtype=dtype)
    shape = (*viewmats.shape[:2], means.shape[1], 2) if has_means2d_grad else (0,)
    return (*gradients, means.new_empty(shape, dtype=dtype))


def _project_fake(means: Tensor, *inputs: Any) -> tuple[Tensor, ...]:
    shape, dtype = (*inputs[4].shape[:2], means.shape[1]), result_dtype(means)
    numbers = [means.new_empty((*shape, *each), dtype=dtype) for each in ((2,), (3,), (), (), (2,))]
    return (*numbers, means.new_empty(shape, dtype=torch.int64))


def _save_for_backward(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs[:TENSORS], *output)
    ctx.settings = inputs[TENSORS : TENSORS + SETTINGS]


def _splat_backward(ctx: Any, d_rgb: Tensor, d_alpha: Tensor, d_depth: Tensor, _: None) -> tuple[Tensor | None, ...]:
    saved = ctx.saved_tensors  # activation checkpointing computes them when they are read, which it allows once
    tensors, output = saved[:TENSORS], saved[TENSORS:]
    has_viewmats_grad, has_means2d_grad = ctx.needs_input_grad[5], ctx.needs_input_grad[-1]
    *gradients, viewmats, means2d = torch.ops.globalsplat.splat_backward(
        *tensors, *ctx.settings, *output, d_rgb, d_alpha, d_depth, has_viewmats_grad, has_means2d_grad
    )
    gradients = [gradient.to(tensor.dtype) for gradient, tensor in zip(gradients, tensors, strict=False)]
    return (
        *gradients,
        viewmats.to(tensors[5].dtype) if has_viewmats_grad else None,
        None,
        *[None] * SETTINGS,
        means2d if has_means2d_grad else None,
    )


def _no_second_gradients(*_: Any) -> NoReturn:
    raise RuntimeError("rasterization can't be differentiated twice")


def _no_gradients(ctx: Any, *_: Any) -> tuple[None, ...]:
    return (None,) * (TENSORS + SETTINGS)


torch.library.register_fake("globalsplat::splat", _splat_fake)
torch.library.register_fake("globalsplat::splat_backward", _splat_backward_fake)
torch.library.register_fake("globalsplat::project", _project_fake)
torch.library.register_autograd("globalsplat::splat", _splat_backward, setup_context=_save_for_backward)
torch.library.register_autograd("globalsplat::splat_backward", _no_second_gradients)
# The projected means receive gradients, which are read from them. splat() gives the same gradients to the Gaussians itself.
torch.library.register_autograd("globalsplat::project", _no_gradients)
