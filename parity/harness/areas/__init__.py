"""The cases of the comparison, one module per area. Each case is followed by its reference function."""

from ..registry import CASES, REFERENCES

# The order of the imports is that of the cases in the table of results.
# isort: off
from . import tokens, encoder, decoder, growth, normalization, rasterizer  # noqa: F401
from . import losses, perceptual, photos, training, model  # noqa: F401

__all__ = ["CASES", "REFERENCES"]
