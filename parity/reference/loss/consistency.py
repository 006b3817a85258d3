"""Consistency loss: two subsets of the views should render the same opacity and depth."""

OPACITY_WEIGHT = 1e-3
DEPTH_WEIGHT = 1e-2
SUPPORT = 0.01  # depth is compared where both accumulated opacities exceed this


def symmetric_l1(x, y):
    """Returns 1/2 |x - sg(y)| + 1/2 |y - sg(x)|, elementwise: the value of |x - y| and half of its gradient."""
    return 0.5 * (x - y.detach()).abs() + 0.5 * (y - x.detach()).abs()


def consistency(opacity_a, opacity_b, depth_a, depth_b, opacity_weight=OPACITY_WEIGHT, depth_weight=DEPTH_WEIGHT):
    """Returns 1e-3 L1(A_a, A_b) + 1e-2 L1(D_a, D_b) of four tensors of one shape [...]."""
    opacity = symmetric_l1(opacity_a, opacity_b).mean()
    supported = ((opacity_a > SUPPORT) & (opacity_b > SUPPORT)).to(depth_a.dtype)
    depth = (supported * symmetric_l1(depth_a, depth_b)).sum() / supported.sum().clamp(min=1.0)
    return opacity_weight * opacity + depth_weight * depth
