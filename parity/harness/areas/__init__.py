"""The cases, in one module per area: each case, followed by its reference function."""

from ..registry import CASES, REFERENCES

# Imported in the order of the cases in the table.
from . import tokens, encoder, decoder, growth, normalization, rasterizer  # noqa: F401
from . import losses, perceptual, photos, training, model  # noqa: F401

__all__ = ["CASES", "REFERENCES"]
