"""Perturbations of correct results, for the self-test of the comparison: it must reject each of them."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from .compare import compare_tensor, gradient_scale, norm

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
