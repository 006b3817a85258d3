"""Times the splat op beside gsplat's implementation in PyTorch, which runs without CUDA, in one run.

python python/benchmarks/gsplat_in_pytorch.py [--gaussians N] [--size PIXELS] [--rounds N]

Both render a random scene from one camera and compute all gradients, in float32. The rounds alternate. Run it with the Python of an
environment that has the package and gsplat.
"""

import argparse
import statistics
import sys
import time
from pathlib import Path

import globalsplat
import torch

sys.path.append(str(Path(__file__).parents[1] / "tests"))  # noqa: TID251 (the tests aren't a package)
import gsplat_reference


def scene(count, size):
    generator = torch.Generator().manual_seed(1)
    means = torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 5.0])
    scales = 0.02 + 0.05 * torch.rand(count, 3, generator=generator)
    quats, opacities = torch.randn(count, 4, generator=generator), torch.rand(count, generator=generator)
    colors = torch.rand(count, 3, generator=generator)
    viewmats, Ks = torch.eye(4)[None], torch.tensor([[[size, 0.0, size / 2], [0.0, size, size / 2], [0.0, 0.0, 1.0]]])
    inputs = [tensor.requires_grad_() for tensor in (means, quats, scales, opacities, colors)]
    return inputs, viewmats, Ks


def seconds(render, inputs, viewmats, Ks, size):
    start = time.perf_counter()
    image, alpha, _ = render(*inputs, viewmats, Ks, size, size)
    torch.autograd.grad(image.sum() + alpha.sum(), inputs)
    return time.perf_counter() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--gaussians", type=int, default=2000)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    inputs = (*scene(options.gaussians, options.size), options.size)
    renders = {"globalsplat": globalsplat.rasterization, "gsplat in PyTorch": gsplat_reference.rasterization}
    for render in renders.values():
        seconds(render, *inputs)
    times = {name: [] for name in renders}
    for _ in range(options.rounds):
        for name, render in renders.items():
            times[name].append(seconds(render, *inputs))
    medians = {name: statistics.median(values) for name, values in times.items()}
    for name, median in medians.items():
        print(f"{name}: {1e3 * median:.2f} ms forward and backward")
    ratio = medians["gsplat in PyTorch"] / medians["globalsplat"]
    print(
        f"{options.gaussians} Gaussians, {options.size}x{options.size} pixels, {globalsplat.simd_level()}: {ratio:.0f} times as fast"
    )


if __name__ == "__main__":
    main()
