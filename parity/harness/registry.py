"""Registry of cases and of their reference functions.

A case is a generator of draws, each a configuration, parameters and inputs. Its name is that of the function; the
program computes `module`, by default the same name.

The reference function of a module calls parity/reference with the names of the exchange: f(config, params, inputs) -> outputs, all
torch tensors. `config` has the program's keys, and parameters have the published names relative to the module, as in a
request.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .tolerance import FLOAT32, Tolerance

CASES = {}
REFERENCES = {}  # reference functions by module


@dataclass
class Draw:
    """The random inputs of one comparison. `label` distinguishes it from the other draws of its case."""

    label: str
    inputs: dict = field(default_factory=dict)
    config: dict = field(default_factory=dict)
    params: dict = field(default_factory=dict)
    differentiate: tuple = ()
    module: str = ""
    tolerance: Tolerance = FLOAT32
    on_gpu: Tolerance | None = None  # replaces `tolerance` on a GPU if a library has larger rounding errors there
    gradients: bool = True
    large: bool = False  # whether the reference computes in float32, on more than one core
    doubtful: np.ndarray | None = None  # mask of pixels within rounding of a threshold, [B, C, H, W]
    close_calls: Callable[[], list] = list  # decisions of a network that a GPU may make differently

    def __post_init__(self):
        self.gradients = self.gradients and bool(self.params or self.differentiate)


def case(function):
    """Registers a function as the case of its name (decorator)."""
    enter(CASES, function.__name__, function)
    return function


def reference_for(module):
    """Registers a function as the reference of `module`, which several cases may use (decorator)."""

    def register(function):
        enter(REFERENCES, module, function)
        return function

    return register


def enter(registry, name, function):
    """Adds a function to a registry. Asserts that its name is unique: the modules of `areas` share one registry."""
    assert name not in registry, f"{name} is in {registry[name].__module__} and in {function.__module__}"
    registry[name] = function


def by(*sizes):
    """Formats a shape as text."""
    return "×".join(map(str, sizes))
