"""A dense rasterizer that evaluates every Gaussian at every pixel: slow, differentiable by autograd, with all rules."""

import math

import torch

from .rotation import matrix_from_quaternion

NEAR = 0.01
EPS_2D = 0.05
JACOBIAN_MARGIN = 0.15  # of the image size, on each side
SMALLEST_ALPHA = 1.0 / 255.0
LARGEST_ALPHA = 0.999
SMALLEST_TRANSMITTANCE = 1e-4
SMALLEST_ACCUMULATION = 1e-10
UNSEEN = 1e-3  # pixels that are added to the contribution of every Gaussian


def covariance(scales, quaternions):
    """Returns covariances R S S^T R^T [N, 3, 3] of scales [N, 3] and quaternions [N, 4] of any norm."""
    rs = matrix_from_quaternion(quaternions) * scales[:, None, :]
    return rs @ rs.transpose(-1, -2)


def project(means, scales, quaternions, w2c, intrinsic, width, height, eps2d=EPS_2D, antialiased=False):
    """Projects Gaussians (means [N, 3], scales [N, 3], quaternions [N, 4]) to a camera (w2c [4, 4], intrinsic [3, 3]).

    Returns a dict of mean2d [N, 2], cov2d [N, 2, 2] (with eps2d), conic [N, 3] = (a, b, c) of [[a, b], [b, c]] =
    cov2d^-1, depth [N], visible [N], compensation [N]. Values of a Gaussian that is not visible are finite and have no
    meaning. compensation is the factor of opacities: 1, or sqrt(det(cov2d without eps2d) / det(cov2d)) if `antialiased`.
    """
    rotation, translation = w2c[:3, :3], w2c[:3, 3]
    fx, fy, cx, cy = intrinsic[0, 0], intrinsic[1, 1], intrinsic[0, 2], intrinsic[1, 2]
    x, y, depth = (means @ rotation.T + translation).unbind(-1)
    in_front = depth > NEAR
    z = torch.where(in_front, depth, 1.0)  # keeps the division finite for Gaussians that are not drawn
    x_z, y_z = x / z, y / z
    mean2d = torch.stack([fx * x_z + cx, fy * y_z + cy], dim=-1)

    # J = [[fx / z, 0, -fx (x/z) / z], [0, fy / z, -fy (y/z) / z]], with x/z and y/z clamped to near the image.
    margin_x, margin_y = JACOBIAN_MARGIN * width / fx, JACOBIAN_MARGIN * height / fy
    x_z = torch.clamp(x_z, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    y_z = torch.clamp(y_z, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * x_z / z], dim=-1), torch.stack([zero, fy / z, -fy * y_z / z], dim=-1)],
        dim=-2,
    )  # [N, 2, 3]
    jw = jacobian @ rotation
    unfiltered = jw @ covariance(scales, quaternions) @ jw.transpose(-1, -2)
    cov2d = unfiltered + eps2d * torch.eye(2, dtype=means.dtype, device=means.device)

    det = cov2d[:, 0, 0] * cov2d[:, 1, 1] - cov2d[:, 0, 1] * cov2d[:, 1, 0]
    invertible = det > 0
    det = torch.where(invertible, det, 1.0)
    compensation = torch.ones_like(det)
    if antialiased:
        # The determinant as a sum of squares: the product of the eigenvalues cancels for thin Gaussians.
        half = jw @ (matrix_from_quaternion(quaternions) * scales[:, None, :])
        area = torch.linalg.cross(half[:, 0], half[:, 1]).square().sum(-1)
        has_area = area > 0
        compensation = torch.where(has_area, torch.sqrt(torch.where(has_area, area, 1.0) / det), 0.0)
    conic = torch.stack([cov2d[:, 1, 1] / det, -cov2d[:, 0, 1] / det, cov2d[:, 0, 0] / det], dim=-1)
    return {
        "mean2d": mean2d,
        "cov2d": cov2d,
        "conic": conic,
        "depth": depth,
        "visible": in_front & invertible,
        "compensation": compensation,
    }


def sh_basis(direction, coefficients):
    """Returns real spherical harmonics [N, C] of unit directions [N, 3], in 3DGS's order and signs.

    `coefficients` is C, one of 1, 4, 9, 16.
    """
    x, y, z = direction.unbind(-1)
    basis = [torch.full_like(x, 0.28209479177387814)]
    if coefficients > 1:
        c = 0.4886025119029199
        basis += [-c * y, c * z, -c * x]
    if coefficients > 4:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if coefficients > 9:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=-1)


def sh_color(means, sh, w2c):
    """Returns colors [N, 3] of Gaussians (means [N, 3], sh [N, C, 3]) seen by w2c [4, 4].

    The color is max(0, 0.5 + sum of basis(direction) sh).
    """
    center = -w2c[:3, :3].T @ w2c[:3, 3]
    direction = means - center
    # A Gaussian at the camera center is not drawn, but the gradient of this branch must be finite, too.
    direction = direction / direction.norm(dim=-1, keepdim=True).clamp(min=1e-30)
    color = 0.5 + (sh_basis(direction, sh.shape[1])[..., None] * sh).sum(1)
    return torch.where(color > 0, color, 0.0)


def pixel_centers(width, height, dtype=torch.float32, device=None):
    """Returns pixel centers [H W, 2] as (j + 0.5, i + 0.5), row-major."""
    i, j = torch.meshgrid(
        torch.arange(height, dtype=dtype, device=device), torch.arange(width, dtype=dtype, device=device), indexing="ij"
    )
    return torch.stack([j + 0.5, i + 0.5], dim=-1).reshape(-1, 2)


def alphas(projected, opacities, pixels):
    """Returns the visible Gaussians' indices by depth (ties: lower index first), and their uncapped alphas [N, Q] at pixels [Q, 2]."""
    order = torch.argsort(projected["depth"], stable=True)
    order = order[projected["visible"][order]]
    dx, dy = (projected["mean2d"][order][:, None] - pixels[None]).unbind(-1)
    a, b, c = (projected["conic"][order][:, k, None] for k in range(3))
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    return order, opacities[order][:, None] * torch.exp(-sigma)


def composite(projected, opacities, colors, pixels):
    """Composites Gaussians at pixels [Q, 2]. projected is the dict of project(); opacities [N], colors [N, 3].

    Returns RGB [Q, 3], accumulated opacity [Q], expected depth [Q]. In order of depth, for the Gaussians that contribute
    to a pixel:
        w_i = T_i alpha_i,   T_i = prod_{j<i} (1 - alpha_j)
        RGB = sum w c,   A = sum w = 1 - T,   D = sum w z / A
    """
    order, alpha = alphas(projected, opacities, pixels)
    alpha = alpha.masked_fill(alpha > LARGEST_ALPHA, LARGEST_ALPHA)  # no gradient through the cap

    # The selection of contributing Gaussians is not differentiable. T decreases along the list, so a comparison with
    # the threshold of 1e-4 also excludes all Gaussians after the first one that would reach it.
    with torch.no_grad():
        counts = alpha >= SMALLEST_ALPHA
        transmittance = torch.cumprod(torch.where(counts, 1.0 - alpha, 1.0), dim=0)
        counts = counts & (transmittance > SMALLEST_TRANSMITTANCE)
    alpha = torch.where(counts, alpha, 0.0)
    after = torch.cumprod(1.0 - alpha, dim=0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]], dim=0)
    weight = before * alpha  # [N, Q]

    rgb = weight.T @ colors[order]
    accumulated = weight.sum(0)
    covered = accumulated > SMALLEST_ACCUMULATION
    expected = torch.where(
        covered, (weight.T @ projected["depth"][order]) / torch.where(covered, accumulated, 1.0), 0.0
    )
    return rgb, accumulated, expected


def render(means, scales, quaternions, opacities, sh, w2c, intrinsic, width, height, eps2d=EPS_2D, antialiased=False):
    """Renders one scene with one camera on a black background.

    Returns RGB [H, W, 3], accumulated opacity [H, W], expected depth [H, W].
    """
    projected = project(means, scales, quaternions, w2c, intrinsic, width, height, eps2d, antialiased)
    colors = sh_color(means, sh, w2c)
    pixels = pixel_centers(width, height, means.dtype, means.device)
    rgb, accumulated, depth = composite(projected, opacities * projected["compensation"], colors, pixels)
    return rgb.reshape(height, width, 3), accumulated.reshape(height, width), depth.reshape(height, width)


def pixel_weights(means, scales, quaternions, opacities, w2c, intrinsic, width, height):
    """Returns the weights of the Gaussians in the pixels of a camera, [H W, N]: each channel of a render is its product
    with their colors."""
    projected = project(means, scales, quaternions, w2c, intrinsic, width, height)
    pixels = pixel_centers(width, height, means.dtype, means.device)
    one_hot = torch.eye(len(means), dtype=means.dtype)
    return composite(projected, opacities * projected["compensation"], one_hot, pixels)[0]


def fit_colors(gaussians, w2cs, intrinsics, images, masks, steps):
    """Returns the contributions [N] of Gaussians (means, scales, quaternions, opacities, sh) of one scene in pixels, and
    their SH [N, bases, 3] after some steps of accelerated gradient descent on half the sum of squared errors."""
    means, scales, quaternions, opacities, sh = gaussians
    bases = sh.shape[1]
    height, width = images.shape[-2:]
    cameras = list(zip(w2cs, intrinsics, strict=True))
    factors = [pixel_weights(means, scales, quaternions, opacities, *camera, width, height) for camera in cameras]
    contributions = sum(factor.sum(0) for factor in factors)
    degrees = torch.tensor([math.isqrt(basis) for basis in range(bases)], dtype=sh.dtype)
    bounds = bases * (2 * degrees + 1).sqrt() / (4 * math.pi)
    sizes = 1 / (contributions[:, None] * bounds + UNSEEN)

    def gradient(sh):
        sh = sh.detach().requires_grad_()
        errors = [
            mask.flatten()[:, None] * (factor @ sh_color(means, sh, w2c) - image.flatten(1).T) ** 2
            for (w2c, _), factor, image, mask in zip(cameras, factors, images, masks, strict=True)
        ]
        return torch.autograd.grad(0.5 * sum(error.sum() for error in errors), sh)[0]

    ahead = sh
    for step in range(1, steps + 1):
        following = ahead - gradient(ahead) * sizes[..., None]
        ahead = following + (step - 1) / (step + 2) * (following - sh)
        sh = following
    return contributions, sh
