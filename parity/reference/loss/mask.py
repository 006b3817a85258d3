"""Masks of photos in losses: pixels with a weight of 0 contribute nothing."""


def filled(picture, photo, mask):
    """Returns the picture [..., C, H, W] with the photo's pixels where the mask [..., 1, H, W] is 0."""
    return mask * picture + (1.0 - mask) * photo


def mean_weight(mask):
    """Returns the mean of a mask, 1e-6 at least."""
    return mask.mean().clamp_min(1e-6)


def masked_mse(rendered, truth, mask):
    """Returns the mean squared error, weighted by the mask."""
    return (mask * (rendered - truth) ** 2).mean() / mean_weight(mask)


def masked_ssim(picture, truth, mask, ssim):
    """Returns 1 - (1 - SSIM) / mean weight, SSIM that of the filled picture by the function `ssim`."""
    return 1.0 - (1.0 - ssim(filled(picture, truth, mask), truth)) / mean_weight(mask)
