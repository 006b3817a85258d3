"""Tests of the reference against independent computations, where no test of the program holds both to one."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from parity.harness import scenes
from parity.harness.draw import lpips_parameters
from parity.reference import losses, muon, perceptual, splat

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
    images = torch.rand(2, 3, 48, 40, generator=generator)
    mean, deviation = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x, expected, compared = ((2 * images.movedim(1, -1) - 1 - mean) / deviation).movedim(-1, 1), 0.0, 0
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
                a, b = (image.flatten(1).T / (image.flatten(1).T.norm(dim=1)[:, None] + 1e-10) for image in x)
                expected += sum((linear * (p - q) ** 2).sum().item() for p, q in zip(a, b, strict=True)) / len(a)
                compared += 1
    found = perceptual.lpips(network, params, images[:1], images[1:]).item()
    assert compared == 5 and found == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("size", [(11, 11), (48, 37), (64, 96)])
def test_ssim_against_scikit_image(size):
    rng = np.random.default_rng(size[0])
    a = rng.random((*size, 3))
    for b in (np.clip(a + rng.normal(0, 0.1, a.shape), 0, 1), np.roll(a, 2, axis=1), 0.6 * a):
        ours = losses.ssim(*(torch.tensor(image).movedim(-1, 0)[None] for image in (a, b))).item()
        window = {"gaussian_weights": True, "sigma": 1.5, "win_size": 11}
        assert ours == pytest.approx(structural_similarity(a, b, data_range=1.0, channel_axis=-1, **window), abs=1e-9)


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


def harmonics(x, y, z):
    """Returns the real spherical harmonics of a unit direction by their definition, in 3DGS's order and signs."""

    def root(numerator, denominator):
        return math.sqrt(numerator / (denominator * math.pi))

    return [
        0.5 * root(1, 1) + 0.0 * x,
        -root(3, 4) * y, root(3, 4) * z, -root(3, 4) * x,
        0.5 * root(15, 1) * x * y, -0.5 * root(15, 1) * y * z, 0.25 * root(5, 1) * (3 * z * z - 1),
        -0.5 * root(15, 1) * x * z, 0.25 * root(15, 1) * (x * x - y * y),
        -0.25 * root(35, 2) * y * (3 * x * x - y * y), 0.5 * root(105, 1) * x * y * z,
        -0.25 * root(21, 2) * y * (5 * z * z - 1), 0.25 * root(7, 1) * z * (5 * z * z - 3),
        -0.25 * root(21, 2) * x * (5 * z * z - 1), 0.25 * root(105, 1) * z * (x * x - y * y),
        -0.25 * root(35, 2) * x * (x * x - 3 * y * y),
    ]  # fmt: skip


def rotated(q, v):
    """Returns q v q*, the rotation of a vector by a quaternion (w, x, y, z) of any length."""
    q = q / np.linalg.norm(q)
    return v + 2.0 * np.cross(q[1:], np.cross(q[1:], v) + q[0] * v)


def scalar_render(means, scales, quaternions, opacities, sh, w2c, intrinsic, width, height, eps2d, antialiased):
    """Renders one pixel and one Gaussian at a time, which shares no formula with the reference: [H, W, 5]."""
    fx, fy, cx, cy = intrinsic[0, 0], intrinsic[1, 1], intrinsic[0, 2], intrinsic[1, 2]
    center, drawn = -w2c[:3, :3].T @ w2c[:3, 3], []
    for g, mean in enumerate(means):
        x, y, z = w2c[:3, :3] @ mean + w2c[:3, 3]
        if z <= 0.01:
            continue
        axes = np.stack(
            [scale * rotated(quaternions[g], axis) for scale, axis in zip(scales[g], np.eye(3), strict=True)]
        )
        px = min(max(x / z, (-cx - 0.15 * width) / fx), (width - cx + 0.15 * width) / fx)
        py = min(max(y / z, (-cy - 0.15 * height) / fy), (height - cy + 0.15 * height) / fy)
        seen = axes @ w2c[:3, :3].T @ np.array([[fx / z, 0.0], [0.0, fy / z], [-fx * px / z, -fy * py / z]])
        cov = seen.T @ seen
        filtered = cov + eps2d * np.eye(2)
        det = np.linalg.det(filtered)
        if det <= 0:
            continue
        opacity = opacities[g] * (math.sqrt(max(np.linalg.det(cov), 0.0) / det) if antialiased else 1.0)
        direction = (mean - center) / np.linalg.norm(mean - center)
        color = np.maximum(0.0, 0.5 + np.array(harmonics(*direction))[: len(sh[g])] @ sh[g])
        drawn.append((z, g, np.array([fx * x / z + cx, fy * y / z + cy]), np.linalg.inv(filtered), opacity, color))
    drawn.sort(key=lambda item: item[:2])

    images = np.zeros((height, width, 5))
    for row, column in np.ndindex(height, width):
        remaining, depth = 1.0, 0.0
        for z, _, mean, conic, opacity, color in drawn:
            offset = mean - [column + 0.5, row + 0.5]
            alpha = min(0.999, opacity * math.exp(-0.5 * offset @ conic @ offset))
            if alpha < 1 / 255:
                continue
            if remaining * (1 - alpha) <= 1e-4:
                break
            images[row, column, :3] += remaining * alpha * color
            depth += remaining * alpha * z
            remaining *= 1 - alpha
        images[row, column, 3:] = 1 - remaining, depth / (1 - remaining) if 1 - remaining > 1e-10 else 0.0
    return images


@pytest.mark.parametrize("antialiased", [False, True])
def test_splat(antialiased):
    """The rasterizer equals loops over pixels and Gaussians, in scenes of all kinds and with harmonics of all degrees."""
    rng = np.random.default_rng(0)
    for size, make in (scenes.RANDOM | scenes.ADVERSARIAL).values():
        scene = make(rng, size)
        config = scenes.settings(size, antialiased)
        names = ("means", "scales", "quaternions", "opacities", "sh", "w2c", "intrinsics")
        first = [scene[name][0] for name in names[:5]] + [scene[name][0, 0] for name in names[5:]]
        ours = splat.render(*map(torch.tensor, first), **config)
        images = torch.cat([value.reshape(*size, -1) for value in ours], dim=-1)
        expected = scalar_render(*first, **config)
        # Rounding may decide a threshold of extreme Gaussians otherwise at a few pixels.
        close = np.abs(images.numpy() - expected).max(-1) < 1e-9
        assert close.mean() > 0.999


def test_spherical_harmonics():
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator).double(), dim=-1)
    torch.testing.assert_close(splat.sh_basis(direction, 16), torch.stack(harmonics(*direction.unbind(-1)), -1))


def test_capped_alphas_and_negative_colors_have_no_gradient():
    opacity = torch.tensor([1.0], dtype=torch.float64, requires_grad=True)
    center = torch.full((1, 2), 0.5, dtype=torch.float64)
    projected = {"mean2d": center, "conic": torch.tensor([[1.0, 0.0, 1.0]], dtype=torch.float64)}
    projected |= {"depth": torch.ones(1, dtype=torch.float64), "visible": torch.ones(1, dtype=torch.bool)}
    weight, _, _ = splat.composite(projected, opacity, torch.ones(1, 3, dtype=torch.float64), center)
    weight.sum().backward()
    assert weight.tolist() == [[0.999] * 3] and opacity.grad.tolist() == [0.0]
    sh = torch.tensor([[[-9.0, 0.3, 9.0]]], dtype=torch.float64, requires_grad=True)
    color = splat.sh_color(torch.tensor([[0.3, 0.2, 2.0]], dtype=torch.float64), sh, torch.eye(4, dtype=torch.float64))
    color.sum().backward()
    assert color[0, 0].item() == 0.0 and sh.grad[0, :, 0].item() == 0.0 and sh.grad[0, :, 2].item() > 0.0
