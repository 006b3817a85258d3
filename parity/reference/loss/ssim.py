"""SSIM (Wang et al. 2004): similarity of two images in brightness, contrast and structure, window by window."""

import torch

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def weights(like):
    """Returns a Gaussian over the window's pixels, [121], with sum 1."""
    offset = torch.arange(WINDOW, dtype=like.dtype, device=like.device) - WINDOW // 2
    squared_distance = offset[:, None] ** 2 + offset[None, :] ** 2
    gaussian = torch.exp(-squared_distance / (2.0 * SIGMA**2)).flatten()
    return gaussian / gaussian.sum()


def windows(pictures):
    """Extracts all windows that lie inside images [B, C, H, W]. Returns [B, C, windows, 121]."""
    return pictures.unfold(2, WINDOW, 1).unfold(3, WINDOW, 1).flatten(4).flatten(2, 3)


def ssim(picture, truth):
    """Returns the SSIM of two images [B, C, H, W] in [0, 1], at least 11 pixels high and wide: the mean of

    (2 mx my + C1) (2 cov + C2) / ((mx^2 + my^2 + C1) (var_x + var_y + C2))

    with the window's weighted means, and its variances and covariance as unbiased estimates from 121 samples: times
    121 / 120. The mean is over images, channels and windows.
    """
    w = weights(picture)
    sample = WINDOW**2 / (WINDOW**2 - 1)
    x, y = windows(picture), windows(truth)
    mx, my = (x * w).sum(-1), (y * w).sum(-1)
    dx, dy = x - mx[..., None], y - my[..., None]
    var_x, var_y, cov = (sample * (w * product).sum(-1) for product in (dx * dx, dy * dy, dx * dy))
    alike = (2.0 * mx * my + C1) * (2.0 * cov + C2)
    return (alike / ((mx**2 + my**2 + C1) * (var_x + var_y + C2))).mean()
