"""Tests of the reference against independent computations, where no test of the program holds both to one."""

import math

import numpy as np
import pytest
import torch

from parity.harness.draw import lpips_parameters
from parity.reference import muon, perceptual, splat

torch.set_num_threads(1)

# torchvision's `features` of both networks: kernel sizes and output channels of the convolutions between the poolings.
FEATURES = {
    "lpips_vgg": [[(3, 64)] * 2, [(3, 128)] * 2, [(3, 256)] * 3, [(3, 512)] * 3, [(3, 512)] * 3],
    "lpips_alex": [[(11, 64)], [(5, 192)], [(3, 384), (3, 256), (3, 256)]],
}


@pytest.mark.parametrize("network", FEATURES)
def test_lpips(network):
    """LPIPS equals its definition, computed pixel by pixel on features of a sequence of PyTorch modules."""
    generator = torch.Generator().manual_seed(0)
    drawn = lpips_parameters(np.random.default_rng(0), network)
    params = {name: torch.tensor(value) for name, value in drawn.items()}
    pictures = torch.rand(2, 3, 48, 40, generator=generator)
    mean, deviation = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x, expected, compared = ((2 * pictures.movedim(1, -1) - 1 - mean) / deviation).movedim(-1, 1), 0.0, 0
    names = iter(
        [name.removesuffix(".weight") for name in params if name.startswith("conv") and name.endswith(".weight")]
    )
    for i, row in enumerate(FEATURES[network]):
        x = torch.nn.MaxPool2d(2 if network == "lpips_vgg" else 3, 2)(x) if i else x
        for j, (kernel, channels) in enumerate(row):
            name = next(names)
            stride, padding = (4, 2) if kernel == 11 else (1, kernel // 2)
            layer = torch.nn.Conv2d(x.shape[1], channels, kernel, stride, padding)
            layer.load_state_dict({part: params[f"{name}.{part}"] for part in ("weight", "bias")})
            x = layer(x).detach().relu()
            if network == "lpips_alex" or j == len(row) - 1:
                linear = params[f"lin{compared}.weight"].flatten()
                a, b = (picture.flatten(1).T / (picture.flatten(1).T.norm(dim=1)[:, None] + 1e-10) for picture in x)
                expected += sum((linear * (p - q) ** 2).sum().item() for p, q in zip(a, b, strict=True)) / len(a)
                compared += 1
    found = perceptual.lpips(network, params, pictures[:1], pictures[1:]).item()
    assert compared == 5 and found == pytest.approx(expected, rel=1e-4)


def test_muon_against_torch():
    """Muon agrees with PyTorch's, which rounds intermediate values to bfloat16."""
    generator = torch.Generator().manual_seed(0)
    for shape in [(24, 40), (40, 24), (16, 16)]:
        start = torch.randn(shape, generator=generator)
        theirs = torch.nn.Parameter(start.clone())
        rule = {"lr": 0.1, "weight_decay": 0.3, "momentum": 0.95, "adjust_lr_fn": "match_rms_adamw"}
        optimizer = torch.optim.Muon([theirs], **rule)
        ours, mean = start, torch.zeros_like(start)
        for _ in range(4):
            theirs.grad = torch.randn(shape, generator=generator)
            optimizer.step()
            ours, mean = muon.muon_step(ours, theirs.grad, mean, 0.1, 0.3)
        decayed = start * (1 - 0.1 * 0.3) ** 4
        assert (ours - theirs).norm() < 0.02 * (ours - decayed).norm()


def test_spherical_harmonics():
    """The basis equals the real harmonics by their definition, in 3DGS's order and signs."""
    direction = torch.nn.functional.normalize(
        torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).double(), dim=-1
    )
    x, y, z = direction.unbind(-1)

    def root(numerator, denominator):
        return math.sqrt(numerator / (denominator * math.pi))

    expected = [
        0.5 * root(1, 1) * torch.ones_like(x),
        -root(3, 4) * y, root(3, 4) * z, -root(3, 4) * x,
        0.5 * root(15, 1) * x * y, -0.5 * root(15, 1) * y * z, 0.25 * root(5, 1) * (3 * z * z - 1),
        -0.5 * root(15, 1) * x * z, 0.25 * root(15, 1) * (x * x - y * y),
        -0.25 * root(35, 2) * y * (3 * x * x - y * y), 0.5 * root(105, 1) * x * y * z,
        -0.25 * root(21, 2) * y * (5 * z * z - 1), 0.25 * root(7, 1) * z * (5 * z * z - 3),
        -0.25 * root(21, 2) * x * (5 * z * z - 1), 0.25 * root(105, 1) * z * (x * x - y * y),
        -0.25 * root(35, 2) * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    torch.testing.assert_close(splat.sh_basis(direction, 16), torch.stack(expected, -1))
