"""Comparison of the program's result with the reference, tensor by tensor, and perturbations that it must reject."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Tolerance:
    """Maximum relative L2 errors of outputs and gradients.

    `images` replaces `outputs` by a maximum absolute difference (relative to the largest value if that is below 1).
    `why` explains a tolerance larger than FLOAT32 or FLOAT64.
    """

    outputs: float
    gradients: float
    images: float | None = None
    why: str = ""


FLOAT32 = Tolerance(1e-5, 1e-4)
FLOAT64 = Tolerance(1e-9, 1e-7)

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


def is_gradient(name):
    return name.startswith("grad.")


def norm(array):
    return float(np.linalg.norm(np.asarray(array, dtype=np.float64)))


def gradient_scale(expected):
    """Returns the largest norm of the expected gradients, relative to which "zero" is measured."""
    return max((norm(value) for name, value in expected.items() if is_gradient(name)), default=0.0)


def compare_tensor(name, ours, expected, tolerance, scale, doubtful=None):
    """Compares a tensor with the reference's, `expected`. Pixels in the mask `doubtful` [B, C, H, W] are ignored."""
    finding = Finding(name, "relative", tolerance.gradients if is_gradient(name) else tolerance.outputs)
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
    if doubtful is not None and not is_gradient(name):
        # broadcast [B, C, H, W] to [B, C, 3, H, W] if needed
        sure = ~doubtful[:, :, None] if difference.ndim == 5 else ~doubtful
        difference, expected = difference * sure, expected * sure
    length = norm(expected)
    finding.largest = float(np.abs(difference).max(initial=0.0))
    if length > 0.0:
        finding.relative = norm(difference) / length

    if finding.measure == "exact":
        finding.error = finding.largest
    elif is_gradient(name) and (length <= NEGLIGIBLE * scale or name.endswith(ZERO_IN_EXACT_ARITHMETIC)):
        finding.measure, finding.tolerance, finding.relative = "zero", ZERO_TOLERANCE, None
        finding.error = norm(ours) / (scale or 1.0)
    elif tolerance.images is not None and not is_gradient(name):
        finding.measure, finding.tolerance = "absolute", tolerance.images
        peak = float(np.abs(expected).max(initial=0.0))
        finding.error = finding.largest / min(1.0, peak or 1.0)
    elif finding.relative is None:
        finding.measure, finding.error = "absolute", finding.largest
    else:
        finding.error = finding.relative
    return finding


def compare(answer, expected, tolerance, doubtful=None):
    """Returns a finding for every tensor. A result with unexpected tensors fails, too."""
    if "error" in answer:
        return [Finding("answer", "exact", 0.0, problem=answer["error"])]
    scale = gradient_scale(expected)
    findings = [
        compare_tensor(name, answer.get(name), value, tolerance, scale, doubtful) for name, value in expected.items()
    ]
    unexpected = sorted(answer.keys() - expected.keys())
    return findings + [Finding(name, "exact", 0.0, problem="unexpected tensor") for name in unexpected]


# ---- self-test -------------------------------------------------------------------------------------------------------

# Factor by which a tensor is multiplied.
FACTOR = 1.001
# Minimum change that zeroing a slice or swapping axes makes, relative to the tensor's norm.
MIN_SHARE = 1e-2
# Minimum change relative to the tolerance. It takes effect where the tolerance is wide.
MIN_CHANGE_IN_TOLERANCES = 2.0
THREADS = 2


def perturbations(array, tolerance, is_zero, scale):
    """Yields pairs of a description and a perturbed tensor; None stands for a missing tensor.

    If `is_zero`, the tensor should be zero, and its perturbation is relative to `scale`.
    """
    yield "left out", None
    if array.size == 0:
        return
    if array.dtype.kind == "i":
        yield "one more", array + 1
        return
    yield "not a number", np.full_like(array, np.nan)
    if is_zero:
        yield "not zero", array + array.dtype.type(1e-3 * (scale or 1.0))
        return
    factor = max(FACTOR, 1.0 + MIN_CHANGE_IN_TOLERANCES * tolerance)
    yield f"times {factor:g}", array * array.dtype.type(factor)
    share = max(MIN_SHARE, MIN_CHANGE_IN_TOLERANCES * tolerance)
    yield from with_zeroed_slice(array, share)
    yield from with_swapped_axes(array, share)


def with_zeroed_slice(array, share):
    """Yields the tensor with one slice set to zero, for each axis.

    The slice is the smallest one whose norm is at least `share` of the tensor's norm.
    """
    for axis in range(array.ndim):
        if array.shape[axis] == 1:
            continue
        others = tuple(k for k in range(array.ndim) if k != axis)
        shares = np.sqrt(np.sum(np.square(array, dtype=np.float64), axis=others)) / norm(array)
        shares[shares < share] = np.inf
        if np.isfinite(shares).any():
            dropped = array.copy()
            np.moveaxis(dropped, axis, 0)[shares.argmin()] = 0.0
            yield f"slice {shares.argmin()} of axis {axis} dropped", dropped


def with_swapped_axes(array, share):
    """Yields the tensor with two axes of equal length swapped, for the last such pair whose swap changes it by more than `share`."""
    for second in reversed(range(array.ndim)):
        for first in reversed(range(second)):
            if array.shape[first] == array.shape[second] > 1:
                swapped = array.swapaxes(first, second)
                if norm(swapped - array) > share * norm(array):
                    yield f"axes {first} and {second} swapped", swapped
                return


def find_undetected(answer, expected, tolerance, doubtful=None):
    """Perturbs a result that passes, one tensor at a time, and compares the perturbed tensor.

    Returns the number of perturbations and descriptions of those that still pass.
    """
    scale = gradient_scale(expected)

    def perturb(name):
        # compare_tensor() computes in float64, so one conversion serves all perturbations.
        value = expected[name] if expected[name].dtype.kind == "i" else np.asarray(expected[name], dtype=np.float64)
        finding = compare_tensor(name, answer[name], value, tolerance, scale, doubtful)
        is_zero = finding.measure == "zero" or norm(value) == 0.0
        tried, missed = 0, []
        for what, wrong in perturbations(answer[name], finding.tolerance, is_zero, scale):
            tried += 1
            if compare_tensor(name, wrong, value, tolerance, scale, doubtful).passed:
                missed.append(f"{name}: {what}")
        return tried, missed

    # Threads save time because numpy releases the GIL. For a large model, these comparisons are most of the self-test's work.
    with ThreadPoolExecutor(THREADS) as pool:
        found = list(pool.map(perturb, expected))
    return sum(tried for tried, _ in found), [what for _, missed in found for what in missed]
