"""Checks of arguments, which raise a ValueError with one sentence."""

from collections.abc import Sequence
from typing import Any, Protocol


class HasShape(Protocol):
    """A tensor or an array."""

    @property
    def shape(self) -> Sequence[int]: ...


def expect(name: str, value: object, is_valid: bool, expected: str) -> None:
    if not is_valid:
        raise ValueError(f"{name} is {value}, expected {expected}")


def expect_integer(name: str, value: Any, least: int) -> None:
    is_integer = isinstance(value, int) or hasattr(value, "__index__")
    if not is_integer or value < least:
        raise ValueError(f"{name} is {value!r}, expected an integer, {least} or more")


def expect_shape(name: str, value: HasShape, *shape: int | str) -> None:
    """Raises an error if the value doesn't have the shape, in which names stand for any size."""
    sizes = tuple(value.shape)
    if len(sizes) != len(shape) or any(
        not isinstance(expected, str) and size != expected for size, expected in zip(sizes, shape, strict=True)
    ):
        raise ValueError(f"{name} has shape {list(sizes)}, expected [{', '.join(map(str, shape))}]")


def select_harmonics(colors: Any, degree: int) -> Any:
    """Returns the spherical harmonics up to a degree from [..., K, 3]."""
    expect_integer("sh_degree", degree, 0)
    bases = (degree + 1) ** 2
    if bases > colors.shape[-2]:
        found = f"colors has {colors.shape[-2]} spherical harmonics"
        raise ValueError(f"{found}, expected {bases} or more for degree {degree}")
    return colors[..., :bases, :]
