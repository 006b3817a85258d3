"""The cases, a file for each area: what a case draws, and beneath it the twin that answers."""

from ..registry import CASES, TWINS

# In the order in which the table has them.
from . import tokens, encoder, decoder, growth, normalization, rasterizer  # noqa: F401
from . import losses, perceptual, photos, training, model  # noqa: F401

__all__ = ["CASES", "TWINS"]
