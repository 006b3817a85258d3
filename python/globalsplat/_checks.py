"""Checks of arguments, which raise a ValueError with one sentence."""

from collections.abc import Sequence
from typing import Protocol


class HasShape(Protocol):
    """A tensor or an array."""

    @property
    def shape(self) -> Sequence[int]: ...


def expect(name: str, value: object, is_valid: bool, expected: str) -> None:
    if not is_valid:
        raise ValueError(f"{name} is {value}, expected {expected}")


def expect_shape(name: str, value: HasShape, *shape: int) -> None:
    if tuple(value.shape) != shape:
        raise ValueError(f"{name} has shape {list(value.shape)}, expected {list(shape)}")
