"""Where cases and their twins are entered.

A case is a generator of draws: of configuration, parameters and inputs. Its name is the function's; the program is
asked for `module`, by default the same name.

The twin of a module is the reference under the names of the exchange: twin(config, params, inputs) -> outputs, all
torch tensors. `config` has the program's keys, and parameters have the published names relative to the module, as in a
request.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .tolerance import FLOAT32, Tolerance

CASES = {}
TWINS = {}  # by module


@dataclass
class Draw:
    """One question. `label` tells it from the others of its case."""

    label: str
    inputs: dict = field(default_factory=dict)
    config: dict = field(default_factory=dict)
    params: dict = field(default_factory=dict)
    differentiate: tuple = ()
    module: str = ""
    tolerance: Tolerance = FLOAT32
    on_gpu: Tolerance | None = None  # instead of `tolerance`, where a library's own rounding is larger there
    gradients: bool = True
    large: bool = False  # the reference computes in float32, on more than one core
    doubtful: np.ndarray | None = None  # pixels on a threshold, [B, C, H, W]
    close_calls: Callable[[], list] = list  # of a network, which a GPU may decide otherwise

    def __post_init__(self):
        self.gradients = self.gradients and bool(self.params or self.differentiate)


def case(function):
    """Enters the draws of the case that is called as the function."""
    enter(CASES, function.__name__, function)
    return function


def twin(module):
    """Enters the reference's answer to `module`, which several cases may ask for."""

    def register(function):
        enter(TWINS, module, function)
        return function

    return register


def enter(registry, name, function):
    """The files of the areas don't see each other's names: a second case of one name would replace the first."""
    assert name not in registry, f"{name} is in {registry[name].__module__} and in {function.__module__}"
    registry[name] = function


def by(*sizes):
    """A shape as text."""
    return "×".join(map(str, sizes))
