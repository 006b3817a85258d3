"""How far an answer may be from the reference's."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerance:
    """Relative L2 errors; `pictures` is a largest absolute difference (of the largest value, where that is below 1),
    and then holds for outputs instead. `why` says what needs more than FLOAT32 or FLOAT64."""

    outputs: float
    gradients: float
    pictures: float | None = None
    why: str = ""


FLOAT32 = Tolerance(1e-5, 1e-4)
FLOAT64 = Tolerance(1e-9, 1e-7)
