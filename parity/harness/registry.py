"""Registry of cases: what is computed, on which random inputs, by which reference, and how exactly it must agree."""

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from .compare import FLOAT32, Tolerance


@dataclass
class Draw:
    """The random inputs of one comparison.

    `config`, `params` and `inputs` go to the program and to the reference. `prefix` begins the names of the parameters; the
    program gets them without it.
    """

    inputs: dict = field(default_factory=dict)
    config: dict = field(default_factory=dict)
    params: dict = field(default_factory=dict)
    differentiate: tuple = ()  # inputs
    prefix: str = ""
    label: str = ""  # distinguishes it from the other draws of its case
    has_gradients: bool = True
    is_large: bool = False  # whether the reference computes in float32, on more than one core
    doubtful: np.ndarray | None = None  # mask of pixels within rounding of a threshold, [B, C, H, W]

    def __post_init__(self):
        self.has_gradients = self.has_gradients and bool(self.params or self.differentiate)
        if not self.label:
            shapes = [by(*value.shape) for value in list(self.inputs.values())[:2]]
            settings = [f"{key} {value}" for key, value in self.config.items()]
            self.label = ", ".join(shapes + settings)


@dataclass(frozen=True)
class Case:
    """A generator of draws for a module of the program, and the reference function of that module."""

    draws: Callable[[np.random.Generator], Iterator[Draw]]
    reference: Callable
    outputs: tuple
    module: str
    tolerance: Tolerance

    def evaluate(self, config, params, inputs):
        """Calls the reference with the arguments that its signature names. Returns its results, all tensors, by name."""
        given = {"config": config, "params": params, "inputs": inputs} | config | inputs
        found = self.reference(
            **{name: given[name] for name in inspect.signature(self.reference).parameters if name in given}
        )
        if isinstance(found, dict):
            return found
        return dict(zip(self.outputs, found if isinstance(found, tuple) else (found,), strict=True))


CASES: dict[str, Case] = {}


def case(reference, *outputs, module=None, tolerance=FLOAT32):
    """Registers a generator of draws as the case of its name (decorator).

    The program computes `module`, by default the case's name. `outputs` names the values that the reference returns, unless
    it returns a dict; a lone value is the `loss` by default.
    """

    def register(draws):
        name = draws.__name__
        assert name not in CASES, f"{name} is in {CASES[name].draws.__module__} and in {draws.__module__}"
        CASES[name] = Case(draws, reference, outputs or ("loss",), module or name, tolerance)
        return draws

    return register


def by(*sizes):
    """Formats a shape as text."""
    return "×".join(map(str, sizes))
