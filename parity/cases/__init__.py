"""The cases of the comparison. The order of the imports is that of the cases in the table of results."""

# isort: off
from . import layers, model, rasterizer, losses, photos, optimizers  # noqa: F401
