"""The network as a PyTorch module, computed by the reference implementation that the parity checks compare the program with."""

import json
import os
from typing import Any, cast

import torch
from torch import Tensor, nn

from . import _native
from .reference.model import forward


class Model(nn.Module):
    """The network in plain PyTorch.

    Parameters have the names of the weights' files. :attr:`config` has the sizes of the network, and :attr:`stage` and :attr:`mix` the
    state of the curriculum: each scene token exposes 2^stage Gaussians.
    """

    def __init__(self, config: dict[str, Any], weights: dict[str, Tensor], stage: int, mix: float) -> None:
        super().__init__()
        self.config, self.stage, self.mix = config, stage, mix
        for name, weight in weights.items():
            *path, last = name.split(".")
            module: nn.Module = self
            for part in path:
                if part not in module._modules:
                    module.add_module(part, nn.Module())
                module = cast(nn.Module, module._modules[part])
            module.register_parameter(last, nn.Parameter(weight))

    def forward(self, images: Tensor, c2w: Tensor, Ks: Tensor) -> dict[str, Tensor]:
        """Turns views into Gaussians.

        Args:
            images (Tensor): images in [0, 1], whose sides are multiples of the patch size. :math:`(B, V, 3, H, W)`
            c2w (Tensor): camera-to-world matrices in the normalized world, see ``globalsplat.reference.normalize``.
                :math:`(B, V, 4, 4)`
            Ks (Tensor): intrinsic matrices in pixels. :math:`(B, V, 3, 3)`

        Returns:
            A dictionary of the N Gaussians of each scene in the normalized world: ``means`` :math:`(B, N, 3)`, ``quats``
            :math:`(B, N, 4)`, ``scales`` :math:`(B, N, 3)`, ``opacities`` :math:`(B, N)` and ``colors`` :math:`(B, N, K, 3)`, spherical
            harmonics.
        """
        decoded = forward(self.config, dict(self.named_parameters()), images, c2w, Ks, self.stage, self.mix)
        return {
            "means": decoded["means"],
            "quats": decoded["quaternions"],
            "scales": decoded["scales"],
            "opacities": decoded["opacities"],
            "colors": decoded["sh"],
        }


def load_model(weights: str | os.PathLike[str] | None = None) -> Model:
    """Loads the network as a PyTorch module in float32.

    Args:
        weights (str or PathLike, optional): weights in any format that the program reads; by default those that come with this package.

    Examples::

        >>> model = globalsplat.load_model()
        >>> gaussians = model(images, c2w, Ks)
    """
    arrays, config, stage, mix = _native.read_model(weights)
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    return Model(json.loads(config), tensors, stage, mix)
