"""The terms of the training objective that need no trained network."""

import math

import torch

# ---- images ----------------------------------------------------------------------------------------------------------

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def mse(rendered, truth):
    """Returns the mean squared error over all elements."""
    return ((rendered - truth) ** 2).mean()


def window_weights(like):
    """Returns a Gaussian over the pixels of SSIM's window, [121], with sum 1."""
    offset = torch.arange(WINDOW, dtype=like.dtype, device=like.device) - WINDOW // 2
    squared_distance = offset[:, None] ** 2 + offset[None, :] ** 2
    gaussian = torch.exp(-squared_distance / (2.0 * SIGMA**2)).flatten()
    return gaussian / gaussian.sum()


def windows(pictures):
    """Extracts all windows that lie inside images [B, C, H, W]. Returns [B, C, windows, 121]."""
    return pictures.unfold(2, WINDOW, 1).unfold(3, WINDOW, 1).flatten(4).flatten(2, 3)


def ssim(picture, truth):
    """Returns the SSIM (Wang et al. 2004) of two images [B, C, H, W] in [0, 1], at least 11 pixels high and wide: the mean of

    (2 mx my + C1) (2 cov + C2) / ((mx^2 + my^2 + C1) (var_x + var_y + C2))

    with the window's weighted means, and its variances and covariance as unbiased estimates from 121 samples: times
    121 / 120. The mean is over images, channels and windows.
    """
    w = window_weights(picture)
    sample = WINDOW**2 / (WINDOW**2 - 1)
    x, y = windows(picture), windows(truth)
    mx, my = (x * w).sum(-1), (y * w).sum(-1)
    dx, dy = x - mx[..., None], y - my[..., None]
    var_x, var_y, cov = (sample * (w * product).sum(-1) for product in (dx * dx, dy * dy, dx * dy))
    alike = (2.0 * mx * my + C1) * (2.0 * cov + C2)
    return (alike / ((mx**2 + my**2 + C1) * (var_x + var_y + C2))).mean()


def photometric(picture, truth, absolute, similar):
    """Returns absolute L1 + similar SSIM of images [..., C, H, W]."""
    picture, truth = picture.flatten(0, -4), truth.flatten(0, -4)
    return absolute * (picture - truth).abs().mean() + similar * ssim(picture, truth)


# ---- images of which a mask excludes parts: pixels with a weight of 0 contribute nothing -------------------------------


def mean_weight(mask):
    """Returns the mean of a mask, 1e-6 at least."""
    return mask.mean().clamp_min(1e-6)


def masked_mse(rendered, truth, mask):
    """Returns the mean squared error, weighted by the mask."""
    return (mask * (rendered - truth) ** 2).mean() / mean_weight(mask)


def masked_photometric(picture, truth, mask, absolute, similar):
    """Returns absolute L1 + similar SSIM of images [..., C, H, W], weighted by the mask [..., 1, H, W].

    SSIM is 1 - (1 - SSIM) / mean weight for the picture filled with the photo's pixels where the mask is 0.
    """
    picture, truth, mask = (t.flatten(0, -4) for t in (picture, truth, mask))
    difference = (mask * (picture - truth).abs()).mean() / mean_weight(mask)
    filled = mask * picture + (1.0 - mask) * truth
    return absolute * difference + similar * (1.0 - (1.0 - ssim(filled, truth)) / mean_weight(mask))


# ---- depths ----------------------------------------------------------------------------------------------------------

EDGE = 10.0
SUPPORT = 0.01  # depth is compared where both accumulated opacities exceed this


def depth_smoothness(depth, photo, factor):
    """Returns the edge-aware smoothness of depth [..., H, W], 0 at pixels without depth, and photo [..., 3, H, W].

    The loss is `factor` times the mean over all pairs of adjacent pixels of 2 |a - b| / (a + b) exp(-10 |g - h|), where a
    and b are their depths and g and h their gray levels; it is 0 for pairs with a = 0 or b = 0.
    """
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


def masked_depth_smoothness(depth, photo, mask, factor):
    """Returns the smoothness of the depths at pixels with a weight of one half and more."""
    counts = (mask >= 0.5).to(depth.dtype)
    return depth_smoothness(depth * counts, photo, factor) / mean_weight(counts)


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


def frustum(means, w2c, intrinsics, far, image):
    """Returns the frustum loss: every Gaussian center should lie in the frustum of at least one input view.

    Its inputs are means [B, N, 3], w2c [B, V, 4, 4], intrinsics [B, V, 3, 3] in pixels, far [B], and the image's (H, W).

    (u, v)    = (fx x + cx z, fy y + cy z) / max(z, 1e-6)
    violation = relu(-u) + relu(u - (W - 1)) + relu(-v) + relu(v - (H - 1)) + relu(near - z) + relu(z - far)
    loss      = mean log(1 + min over views of violation / 10)
    """
    height, width = image
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
