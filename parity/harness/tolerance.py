"""Tolerances of the comparison with the reference."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerance:
    """Maximum relative L2 errors of outputs and gradients.

    `pictures` replaces `outputs` by a maximum absolute difference (relative to the largest value if that is below 1).
    `why` explains a tolerance larger than FLOAT32 or FLOAT64.
    """

    outputs: float
    gradients: float
    pictures: float | None = None
    why: str = ""


FLOAT32 = Tolerance(1e-5, 1e-4)
FLOAT64 = Tolerance(1e-9, 1e-7)
