"""Frustum loss: every Gaussian centre should lie in the frustum of at least one input view."""

import torch

NEAR = 0.01
SMALLEST_DIVISOR = 1e-6
SOFTNESS = 10.0


def frustum(means, w2c, intrinsic, height, width, far):
    """Returns the scalar loss of means [B, N, 3], w2c [B, V, 4, 4], intrinsic [B, V, 3, 3] in pixels, far [B].

    (u, v)    = (fx x + cx z, fy y + cy z) / max(z, 1e-6)
    violation = relu(-u) + relu(u - (W - 1)) + relu(-v) + relu(v - (H - 1)) + relu(near - z) + relu(z - far)
    loss      = mean log(1 + min over views of violation / 10)
    """
    camera = torch.einsum("bvrc,bnc->bvnr", w2c[..., :3, :3], means) + w2c[..., None, :3, 3]  # [B, V, N, 3]
    x, y, z = camera.unbind(-1)
    divisor = z.clamp(min=SMALLEST_DIVISOR)
    # The clamped divisor divides all of K (x, y, z), principal point included: behind a camera cx z does not cancel.
    u = (intrinsic[..., 0, 0, None] * x + intrinsic[..., 0, 2, None] * z) / divisor
    v = (intrinsic[..., 1, 1, None] * y + intrinsic[..., 1, 2, None] * z) / divisor

    relu = torch.relu
    violation = relu(-u) + relu(u - (width - 1)) + relu(-v) + relu(v - (height - 1))
    violation = violation + relu(NEAR - z) + relu(z - far[:, None, None])
    return torch.log1p(violation.amin(dim=1) / SOFTNESS).mean()
