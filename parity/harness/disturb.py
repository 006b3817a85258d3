"""Perturbations of correct results. The comparison must reject each of them, or it would miss such an error."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from .compare import gradient_scale, compare_tensor, norm

FACTOR = 1.001
# The dropped slice is the smallest one whose norm is at least this fraction of the tensor's norm.
SMALLEST_SHARE = 1e-2
# Errors are at least this multiple of the tolerance, for wide tolerances.
BEYOND = 2.0
THREADS = 2


def disturbances(array, tolerance, is_zero, scale):
    """Yields (description, perturbed tensor). For a tensor that should be zero, the error is relative to `scale`."""
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
    factor = max(FACTOR, 1.0 + BEYOND * tolerance)
    yield f"times {factor:g}", array * array.dtype.type(factor)
    share = max(SMALLEST_SHARE, BEYOND * tolerance)
    yield from without_a_slice(array, share)
    yield from transposed(array, share)


def without_a_slice(array, share):
    """Yields the tensor with a slice set to zero, for each axis in turn."""
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


def transposed(array, share):
    """Yields the tensor with two axes of equal length swapped: the last such pair, if the change is large enough."""
    for second in reversed(range(array.ndim)):
        for first in reversed(range(second)):
            if array.shape[first] == array.shape[second] > 1:
                swapped = array.swapaxes(first, second)
                if norm(swapped - array) > share * norm(array):
                    yield f"axes {first} and {second} swapped", swapped
                return


def undetected(answer, expected, tolerance, doubtful=None):
    """Perturbs a result that passes. Returns the number of perturbations, and those that still pass, as descriptions.

    One tensor is perturbed at a time, so only this tensor is compared.
    """
    scale = gradient_scale(expected)

    def disturb(name):
        # compare_tensor() computes in float64: convert once for all perturbations.
        value = expected[name] if expected[name].dtype.kind == "i" else np.asarray(expected[name], dtype=np.float64)
        finding = compare_tensor(name, answer[name], value, tolerance, scale, doubtful)
        is_zero = finding.measure == "zero" or norm(value) == 0.0
        tried, missed = 0, []
        for what, wrong in disturbances(answer[name], finding.tolerance, is_zero, scale):
            tried += 1
            if compare_tensor(name, wrong, value, tolerance, scale, doubtful).passed:
                missed.append(f"{name}: {what}")
        return tried, missed

    # For a large model this is most of the work, and numpy releases the GIL.
    with ThreadPoolExecutor(THREADS) as pool:
        found = list(pool.map(disturb, expected))
    return sum(tried for tried, _ in found), [what for _, missed in found for what in missed]
