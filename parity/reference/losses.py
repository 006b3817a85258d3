"""The terms of the training objective that need no trained network."""

import math

import torch

# ---- images ----------------------------------------------------------------------------------------------------------

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def mean_weight(mask):
    """Returns the mean of a mask, 1e-6 at least."""
    return mask.mean().clamp_min(1e-6)


def mse(image, ground_truth, mask=None):
    """Returns the mean squared error over all elements, weighted by the mask if there is one."""
    squares = (image - ground_truth) ** 2
    return squares.mean() if mask is None else (mask * squares).mean() / mean_weight(mask)


def window_weights(like):
    """Returns a Gaussian over the pixels of SSIM's window, [121], with sum 1."""
    offset = torch.arange(WINDOW, dtype=like.dtype, device=like.device) - WINDOW // 2
    squared_distance = offset[:, None] ** 2 + offset[None, :] ** 2
    gaussian = torch.exp(-squared_distance / (2.0 * SIGMA**2)).flatten()
    return gaussian / gaussian.sum()


def windows(images):
    """Extracts all windows that lie inside images [B, C, H, W]. Returns [B, C, windows, 121]."""
    return images.unfold(2, WINDOW, 1).unfold(3, WINDOW, 1).flatten(4).flatten(2, 3)


def ssim(image, ground_truth):
    """Returns the SSIM (Wang et al. 2004) of two images [B, C, H, W] in [0, 1], at least 11 pixels high and wide: the mean of

    (2 mx my + C1) (2 cov + C2) / ((mx^2 + my^2 + C1) (var_x + var_y + C2))

    with the window's weighted means, and its variances and covariance as unbiased estimates from 121 samples: times
    121 / 120. The mean is over images, channels and windows.
    """
    w = window_weights(image)
    sample = WINDOW**2 / (WINDOW**2 - 1)
    x, y = windows(image), windows(ground_truth)
    mx, my = (x * w).sum(-1), (y * w).sum(-1)
    dx, dy = x - mx[..., None], y - my[..., None]
    var_x, var_y, cov = (sample * (w * product).sum(-1) for product in (dx * dx, dy * dy, dx * dy))
    alike = (2.0 * mx * my + C1) * (2.0 * cov + C2)
    return (alike / ((mx**2 + my**2 + C1) * (var_x + var_y + C2))).mean()


def photometric(image, ground_truth, l1_weight, ssim_weight, mask=None):
    """Returns l1_weight L1 + ssim_weight SSIM of images [..., C, H, W], weighted by the mask [..., 1, H, W] if there is one.

    Masked SSIM is 1 - (1 - SSIM) / mean weight of the image filled with the ground truth where the mask is 0.
    """
    image, ground_truth = image.flatten(0, -4), ground_truth.flatten(0, -4)
    difference = (image - ground_truth).abs()
    if mask is None:
        return l1_weight * difference.mean() + ssim_weight * ssim(image, ground_truth)
    mask = mask.flatten(0, -4)
    filled = mask * image + (1.0 - mask) * ground_truth
    similarity = 1.0 - (1.0 - ssim(filled, ground_truth)) / mean_weight(mask)
    return l1_weight * (mask * difference).mean() / mean_weight(mask) + ssim_weight * similarity


# ---- depths ----------------------------------------------------------------------------------------------------------

EDGE = 10.0
SUPPORT = 0.01  # depth is compared where both accumulated opacities exceed this


def depth_smoothness(depth, photo, factor, mask=None):
    """Returns the edge-aware smoothness of depth [..., H, W], 0 at pixels without depth, and photo [..., 3, H, W].

    The loss is `factor` times the mean over all pairs of adjacent pixels of 2 |a - b| / (a + b) exp(-10 |g - h|), where a
    and b are their depths and g and h their gray levels; it is 0 for pairs with a = 0 or b = 0. Pixels with a weight below
    one half in the mask count as pixels without depth, and the loss is divided by the fraction of the others.
    """
    if mask is not None:
        counts = (mask >= 0.5).to(depth.dtype)
        return depth_smoothness(depth * counts, photo, factor) / mean_weight(counts)
    gray = photo.mean(-3)
    total, pairs = depth.sum() * 0.0, 0
    for axis in (-1, -2):
        a, b = (depth.narrow(axis, start, depth.shape[axis] - 1) for start in (0, 1))
        g, h = (gray.narrow(axis, start, gray.shape[axis] - 1) for start in (0, 1))
        seen = (a > 0) & (b > 0)
        uneven = 2.0 * (a - b).abs() / torch.where(seen, a + b, 1.0)
        total = total + torch.where(seen, uneven * torch.exp(-EDGE * (g - h).abs()), 0.0).sum()
        pairs += a.numel()
    return factor * total / max(pairs, 1)


def symmetric_l1(x, y):
    """Returns 1/2 |x - sg(y)| + 1/2 |y - sg(x)|, elementwise: the value of |x - y| and half of its gradient."""
    return 0.5 * (x - y.detach()).abs() + 0.5 * (y - x.detach()).abs()


def consistency(alpha_a, alpha_b, depth_a, depth_b, alpha_factor, depth_factor):
    """Compares the accumulated opacities and depths that two subsets of the views render, four tensors of one shape.

    Returns alpha_factor L1(A_a, A_b) + depth_factor L1(D_a, D_b).
    """
    alpha = symmetric_l1(alpha_a, alpha_b).mean()
    supported = ((alpha_a > SUPPORT) & (alpha_b > SUPPORT)).to(depth_a.dtype)
    depth = (supported * symmetric_l1(depth_a, depth_b)).sum() / supported.sum().clamp(min=1.0)
    return alpha_factor * alpha + depth_factor * depth


# ---- Gaussians -------------------------------------------------------------------------------------------------------

NEAR = 0.01
SMALLEST_DIVISOR = 1e-6
SOFTNESS = 10.0

LARGEST_SCALE = 0.05
SH_CAP = 5.0
LARGEST_OPACITY = 0.2
REGULARIZATION = 1e-2


def frustum(means, w2c, intrinsics, far, image_size):
    """Returns the frustum loss: every Gaussian center should lie in the frustum of at least one input view.

    Its inputs are means [B, N, 3], w2c [B, V, 4, 4], intrinsics [B, V, 3, 3] in pixels, far [B], and the image size (H, W).

    (u, v)    = (fx x + cx z, fy y + cy z) / max(z, 1e-6)
    violation = relu(-u) + relu(u - (W - 1)) + relu(-v) + relu(v - (H - 1)) + relu(near - z) + relu(z - far)
    loss      = mean log(1 + min over views of violation / 10)
    """
    height, width = image_size
    camera = torch.einsum("bvrc,bnc->bvnr", w2c[..., :3, :3], means) + w2c[..., None, :3, 3]  # [B, V, N, 3]
    x, y, z = camera.unbind(-1)
    divisor = z.clamp(min=SMALLEST_DIVISOR)
    # The clamped divisor divides all of K (x, y, z), principal point included: behind a camera cx z does not cancel.
    u = (intrinsics[..., 0, 0, None] * x + intrinsics[..., 0, 2, None] * z) / divisor
    v = (intrinsics[..., 1, 1, None] * y + intrinsics[..., 1, 2, None] * z) / divisor

    relu = torch.relu
    violation = relu(-u) + relu(u - (width - 1)) + relu(-v) + relu(v - (height - 1))
    violation = violation + relu(NEAR - z) + relu(z - far[:, None, None])
    return torch.log1p(violation.amin(dim=1) / SOFTNESS).mean()


def decoder_regularization(log_scales, rotations, sh, opacity_logits, opacity):
    """Returns the regularizer of the outputs of the decoder's heads, per candidate, before clamps and merging.

    L_scale   = mean relu(log s - log 0.05)^2 of log-scales before their clamp
    L_rot     = mean r^2 of the raw 6D residuals
    L_SH      = mean softplus(|c| - 5)^2 of the raw coefficients
    L_opacity = mean alpha + mean relu(o - logit(0.2))^2
    loss      = 1e-2 (L_scale + L_rot + L_SH, and L_opacity if `opacity`)
    """
    total = (torch.relu(log_scales - math.log(LARGEST_SCALE)) ** 2).mean() + (rotations**2).mean()
    total = total + (torch.nn.functional.softplus(sh.abs() - SH_CAP) ** 2).mean()
    if opacity:
        threshold = math.log(LARGEST_OPACITY / (1.0 - LARGEST_OPACITY))
        total = total + torch.sigmoid(opacity_logits).mean()
        total = total + (torch.relu(opacity_logits - threshold) ** 2).mean()
    return REGULARIZATION * total
