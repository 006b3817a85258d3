"""Comparison of the program's result with the reference, tensor by tensor."""

from dataclasses import dataclass

import numpy as np

# A gradient is only rounding error, without a direction to compare, if its norm relative to the largest one of the case
# is at most NEGLIGIBLE, or if it is zero in exact arithmetic because softmax is invariant to a constant. Then its norm
# relative to the largest one must be at most ZERO_TOLERANCE.
NEGLIGIBLE = 1e-12
ZERO_IN_EXACT_ARITHMETIC = ("mem_k.bias",)
ZERO_TOLERANCE = 1e-5


@dataclass
class Finding:
    """Difference of one tensor of a result from the reference."""

    tensor: str
    shape: tuple
    measure: str  # "relative", "absolute", "zero" or "exact"
    tolerance: float
    error: float = np.inf  # in units of `measure`
    largest: float = np.inf  # largest absolute difference
    relative: float | None = None  # relative L2 error
    problem: str = ""

    @property
    def passed(self):
        return not self.problem and self.error <= self.tolerance

    @property
    def share(self):
        """Returns the error as a fraction of the tolerance."""
        if self.problem or self.tolerance == 0.0:
            return 0.0 if self.passed else np.inf
        return self.error / self.tolerance


def norm(array):
    return float(np.linalg.norm(np.asarray(array, dtype=np.float64)))


def gradient_scale(expected):
    """Returns the largest norm of the expected gradients, relative to which "zero" is measured."""
    return max((norm(value) for name, value in expected.items() if name.startswith("grad.")), default=0.0)


def compare_tensor(name, ours, expected, tolerance, scale, doubtful=None):
    """Compares a tensor with the reference's, `expected`. Pixels in the mask `doubtful` [B, C, H, W] are ignored."""
    is_gradient = name.startswith("grad.")
    allowed = tolerance.gradients if is_gradient else tolerance.outputs
    finding = Finding(name, expected.shape, "relative", allowed)
    if ours is None:
        finding.problem = "missing"
    elif ours.shape != expected.shape:
        finding.problem = f"has shape {ours.shape}, expected {expected.shape}"
    elif not np.isfinite(ours).all():
        finding.problem = f"{int((~np.isfinite(ours)).sum())} numbers are not finite"
    if finding.problem:
        return finding

    if expected.dtype.kind == "i":
        finding.measure, finding.tolerance = "exact", 0.0
    ours, expected = np.asarray(ours, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    difference = ours - expected
    if doubtful is not None and not is_gradient:
        # broadcast [B, C, H, W] to [B, C, 3, H, W] if needed
        sure = ~doubtful[:, :, None] if difference.ndim == 5 else ~doubtful
        difference, expected = difference * sure, expected * sure
    length = norm(expected)
    finding.largest = float(np.abs(difference).max(initial=0.0))
    if length > 0.0:
        finding.relative = norm(difference) / length

    if finding.measure == "exact":
        finding.error = finding.largest
    elif is_gradient and (length <= NEGLIGIBLE * scale or name.endswith(ZERO_IN_EXACT_ARITHMETIC)):
        finding.measure, finding.tolerance, finding.relative = "zero", ZERO_TOLERANCE, None
        finding.error = norm(ours) / (scale or 1.0)
    elif tolerance.pictures is not None and not is_gradient:
        finding.measure, finding.tolerance = "absolute", tolerance.pictures
        peak = float(np.abs(expected).max(initial=0.0))
        finding.error = finding.largest / min(1.0, peak or 1.0)
    elif length == 0.0:
        finding.measure, finding.error = "absolute", finding.largest
    else:
        finding.error = norm(difference) / length
    return finding


def compare(answer, expected, tolerance, doubtful=None):
    """Returns a finding for every tensor. A result with unexpected tensors fails, too."""
    if "error" in answer:
        return [Finding("answer", (), "exact", 0.0, problem=answer["error"])]
    scale = gradient_scale(expected)
    findings = [
        compare_tensor(name, answer.get(name), value, tolerance, scale, doubtful) for name, value in expected.items()
    ]
    unexpected = sorted(answer.keys() - expected.keys())
    findings += [Finding(name, answer[name].shape, "exact", 0.0, problem="unexpected tensor") for name in unexpected]
    return findings
