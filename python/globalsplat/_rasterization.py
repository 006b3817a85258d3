"""gsplat's `rasterization` on the splat op."""

import math
from typing import Any, Literal

import torch
from torch import Tensor

from ._checks import expect, expect_integer, expect_shape, select_harmonics
from ._ops import result_dtype

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]

#: Channels that one call of the op renders.
CHANNELS = 3
#: Maximum number of standard deviations of gsplat's radii.
RADIUS = 3.33
#: Maximum radius in pixels.
MAX_RADIUS = 2.0**30


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    *,
    origin: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    r"""Renders 3D Gaussians from cameras, on the CPU or a CUDA device.

    Takes the arguments of `gsplat.rasterization` 1.5 and returns what it returns. Renders are differentiable with respect to
    :attr:`means`, :attr:`quats`, :attr:`scales`, :attr:`opacities`, :attr:`colors`, :attr:`backgrounds` and :attr:`viewmats`, and
    bit-identical for any number of threads. float64 tensors are rendered in float64, on the CPU; all others in float32.

    A number that isn't finite makes the images NaN that depend on it: all images of its scene, or that of its camera, and in
    :attr:`colors` the pixels that show it. The gradients of such images are NaN, too.

    .. note::
        More than three channels take a pass for every three. Colors of each camera, :math:`(*, C, N, \ldots)`, take a projection for
        each camera.

    Args:
        means (Tensor): centers of the Gaussians. :math:`(*, N, 3)`
        quats (Tensor): rotations as quaternions (w, x, y, z) of any length. :math:`(*, N, 4)`
        scales (Tensor): standard deviations along the Gaussians' axes. :math:`(*, N, 3)`
        opacities (Tensor): opacities in [0, 1]. :math:`(*, N)`
        colors (Tensor): colors or features, :math:`(*, [C,] N, D)`, or with :attr:`sh_degree` coefficients of spherical harmonics,
            :math:`(*, [C,] N, K, 3)`.
        viewmats (Tensor): world-to-camera matrices, with x right, y down and z forward. :math:`(*, C, 4, 4)`
        Ks (Tensor): intrinsic matrices in pixels. Gets no gradient. :math:`(*, C, 3, 3)`
        width (int): width of the images in pixels.
        height (int): height of the images in pixels.
        near_plane (float): Gaussians whose depth isn't above it are left out.
        far_plane (float): Gaussians whose depth isn't below it are left out.
        eps2d (float): added to the diagonal of projected covariances, in pixels². Splats of GlobalSplat are made for 0.05.
        sh_degree (int, optional): degree of the spherical harmonics to use, 0 to 3. If ``None``, :attr:`colors` are used as they are.
        backgrounds (Tensor, optional): colors of the backgrounds, without effect on depths. :math:`(*, C, D)`
        render_mode (str): what to render: ``"RGB"`` the colors, ``"D"`` accumulated depths :math:`\sum_i w_i z_i`, ``"ED"`` expected
            depths :math:`\sum_i w_i z_i / \sum_i w_i`, or colors and depths, ``"RGB+D"`` and ``"RGB+ED"``.
        rasterize_mode (str): ``"antialiased"`` reduces opacities by what :attr:`eps2d` adds to the areas of the projected Gaussians.
        packed, tile_size, channel_chunk, segmented: accepted and without effect.
        radius_clip, sparse_grad, absgrad, distributed, camera_model, covars, with_ut, with_eval3d, radial_coeffs, tangential_coeffs,
            thin_prism_coeffs, ftheta_coeffs, rolling_shutter, viewmats_rs: only their default values are implemented.
        origin (Tensor, optional): where :attr:`means` have their origin in the world of :attr:`viewmats`, which are best float64 if it
            is far away. Not an argument of gsplat. :math:`(3,)`

    Returns:
        A tuple of

        - **render_colors** (Tensor): :math:`(*, C, H, W, X)`; X is D, 1 for depths, or D + 1 for both.
        - **render_alphas** (Tensor): accumulated opacities. :math:`(*, C, H, W, 1)`
        - **meta** (dict): the projected Gaussians, as gsplat returns them with ``packed=False``, which its strategies have to be told:
          ``means2d`` :math:`(*, C, N, 2)`, ``radii`` :math:`(*, C, N, 2)`, zero for those that aren't visible, ``depths``
          :math:`(*, C, N)`, ``conics`` :math:`(*, C, N, 3)` and ``opacities`` :math:`(*, C, N)`; and the sizes of the image, the tiles
          and the batch. Lists of tiles are absent. ``means2d`` receives the gradient of the images, which densification reads. No
          gradient of a loss on the values of ``meta`` reaches the Gaussians.

    Raises:
        NotImplementedError: for arguments of gsplat that aren't implemented.
        ValueError: if shapes don't fit, or an argument is out of range.

    Examples::

        >>> means = torch.randn(100, 3) + torch.tensor([0.0, 0.0, 5.0])
        >>> quats, scales = torch.randn(100, 4), torch.full((100, 3), 0.1)
        >>> opacities, colors = torch.rand(100), torch.rand(100, 3)
        >>> viewmats, Ks = torch.eye(4)[None], torch.tensor([[[300.0, 0, 150], [0, 300, 100], [0, 0, 1]]])
        >>> image, alpha, meta = rasterization(means, quats, scales, opacities, colors, viewmats, Ks, 300, 200)
        >>> image.shape
        torch.Size([1, 200, 300, 3])
    """
    del packed, channel_chunk, segmented
    _refuse(
        radius_clip=radius_clip != 0.0,
        sparse_grad=sparse_grad,
        absgrad=absgrad,
        distributed=distributed,
        camera_model=camera_model != "pinhole",
        covars=covars is not None,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        radial_coeffs=radial_coeffs is not None,
        tangential_coeffs=tangential_coeffs is not None,
        thin_prism_coeffs=thin_prism_coeffs is not None,
        ftheta_coeffs=ftheta_coeffs is not None,
        rolling_shutter=rolling_shutter is not None and getattr(rolling_shutter, "name", None) != "GLOBAL",
        viewmats_rs=viewmats_rs is not None,
    )
    if sh_degree is not None and sh_degree > 3:
        raise NotImplementedError(f"sh_degree is {sh_degree}, and spherical harmonics are implemented up to degree 3")
    for name, value in (("width", width), ("height", height), ("tile_size", tile_size)):
        expect_integer(name, value, 1)
    expect("eps2d", eps2d, 0.0 <= eps2d < math.inf, "0 or more")
    expect("near_plane", near_plane, near_plane >= 0.0, "0 or more")
    expect("far_plane", far_plane, far_plane > near_plane, "more than near_plane")
    has_colors, has_depth = render_mode in ("RGB", "RGB+D", "RGB+ED"), render_mode != "RGB"
    expect("render_mode", render_mode, has_colors or render_mode in ("D", "ED"), "RGB, D, ED, RGB+D or RGB+ED")
    expect("rasterize_mode", rasterize_mode, rasterize_mode in ("classic", "antialiased"), "classic or antialiased")

    tensors = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "viewmats": viewmats,
        "Ks": Ks,
    }
    if not has_colors:
        backgrounds = None
    if backgrounds is not None:
        tensors["backgrounds"] = backgrounds
    for name, tensor in tensors.items():
        expect(f"the type of {name}", type(tensor).__name__, isinstance(tensor, Tensor), "Tensor")
        expect(f"the device of {name}", tensor.device, tensor.device == means.device, f"{means.device}, that of means")
    batch = means.shape[:-2]
    tail = ("D",) if sh_degree is None else ("K", 3)
    expect_shape("means", means, *batch, "N", 3)
    expect_shape("viewmats", viewmats, *batch, "C", 4, 4)
    count, cameras = means.shape[-2], viewmats.shape[-3]
    has_camera_colors = colors.dim() == len(batch) + 2 + len(tail)
    expect_shape("quats", quats, *batch, count, 4)
    expect_shape("scales", scales, *batch, count, 3)
    expect_shape("opacities", opacities, *batch, count)
    expect_shape("Ks", Ks, *batch, cameras, 3, 3)
    expect_shape("colors", colors, *batch, *((cameras,) if has_camera_colors else ()), count, *tail)
    channels = colors.shape[-1]
    expect("the number of channels of colors", channels, channels >= 1, "1 or more")
    if backgrounds is not None:
        expect_shape("backgrounds", backgrounds, *batch, cameras, channels)
    if origin is not None:
        expect_shape("origin", origin, 3)
        to_world = torch.eye(4, dtype=torch.float64, device=means.device)
        to_world[:3, 3] = torch.as_tensor(origin)
        viewmats = viewmats.double() @ to_world

    dtype = result_dtype(means)
    scenes = math.prod(batch)

    def flat(tensor: Tensor, dims: int) -> Tensor:
        """Returns [B, ...] with `dims` dimensions after those of the batch."""
        return tensor.to(dtype).reshape(scenes, *tensor.shape[tensor.dim() - dims :])

    gaussians = [flat(means, 2), flat(quats, 2), flat(scales, 2), flat(opacities, 1)]
    viewmats, Ks = flat(viewmats, 3), flat(Ks, 3).detach()
    colors = flat(colors, 1 + len(tail) + has_camera_colors)
    if has_camera_colors:
        # Every camera sees Gaussians of its own.
        gaussians = [tensor.repeat_interleave(cameras, 0) for tensor in gaussians]
        viewmats, Ks, colors = viewmats.flatten(0, 1)[:, None], Ks.flatten(0, 1)[:, None], colors.flatten(0, 1)
    if sh_degree is not None:
        passes = [select_harmonics(colors, sh_degree)]
    elif has_colors:
        padded = torch.nn.functional.pad(colors, (0, -channels % CHANNELS))
        passes = list(padded.unsqueeze(-2).split(CHANNELS, -1))
    else:
        passes = [colors.new_zeros(*colors.shape[:-1], 1, CHANNELS)]

    settings = (width, height, eps2d, near_plane, far_plane, rasterize_mode == "antialiased", sh_degree is None)
    means2d, *projected = torch.ops.globalsplat.project(*gaussians, passes[0], viewmats, Ks, *settings)
    # Gradients reach the tensor in `meta`, so the op gets what is made from it.
    out = (*batch, cameras)
    shape, means2d = means2d.shape, means2d.reshape(*out, count, 2)
    renders = [
        torch.ops.globalsplat.splat(*gaussians, of_pass, viewmats, Ks, *settings, means2d.reshape(shape))
        for of_pass in passes
    ]
    alpha, depth = renders[0][1][..., None], renders[0][2][..., None]
    images = []
    if has_colors:
        rgb = torch.cat([render[0] for render in renders], 2).movedim(2, -1)[..., :channels]
        if backgrounds is not None:
            rgb = rgb + (1.0 - alpha) * backgrounds.to(dtype).reshape(*alpha.shape[:2], 1, 1, channels)
        images.append(rgb)
    if has_depth:
        images.append(depth if render_mode.endswith("ED") else depth * alpha)
    meta = {
        # gsplat's indices of packed results.
        **dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids")),
        **_describe(means2d, [tensor.detach() for tensor in projected], width, height),
        "width": width,
        "height": height,
        "tile_size": tile_size,
        "tile_width": math.ceil(width / tile_size),
        "tile_height": math.ceil(height / tile_size),
        "n_batches": scenes,
        "n_cameras": cameras,
    }
    image = torch.cat(images, -1)
    return image.reshape(*out, *image.shape[2:]), alpha.reshape(*out, *alpha.shape[2:]), meta


def _describe(means2d: Tensor, projected: list[Tensor], width: int, height: int) -> dict[str, Tensor]:
    """Returns the entries of `meta` for the Gaussians with these projected means, and what else the op returns of them."""
    conics, depths, opacities, variances, visible = projected
    # Standard deviations within which alpha is 1/255 or more.
    extents = (2.0 * torch.log(255.0 * opacities)).clamp(min=0.0).sqrt().clamp(max=RADIUS)
    radii = torch.ceil(extents[..., None] * variances.sqrt()).clamp(max=MAX_RADIUS)
    size = torch.tensor([width, height], dtype=radii.dtype, device=radii.device)
    centers = means2d.detach().reshape(radii.shape)
    is_visible = (visible > 0) & ((centers + radii > 0) & (centers - radii < size)).all(-1)
    out = means2d.shape[:-1]
    return {
        "radii": torch.where(is_visible[..., None], radii, 0.0).to(torch.int32).reshape(means2d.shape),
        "means2d": means2d,
        "depths": depths.reshape(out),
        "conics": conics.reshape(*out, 3),
        "opacities": opacities.reshape(out),
    }


def _refuse(**arguments: bool) -> None:
    """Raises an exception if any of the arguments isn't implemented."""
    names = [name for name, is_used in arguments.items() if is_used]
    if names:
        raise NotImplementedError(f"{', '.join(names)}: implemented only with the default value")
