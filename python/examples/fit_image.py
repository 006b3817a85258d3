"""Fits 2,000 Gaussians to an image: python fit_image.py image.png fitted.png"""

import sys

import globalsplat
import numpy as np
import torch
from PIL import Image

image = torch.from_numpy(np.asarray(Image.open(sys.argv[1]).convert("RGB"), np.float32) / 255.0)
height, width = image.shape[:2]
viewmats = torch.eye(4)[None]
Ks = torch.tensor([[[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]]])

means = (torch.rand(2000, 3) - 0.5) * torch.tensor([1.0, height / width, 0.1]) + torch.tensor([0.0, 0.0, 1.0])
parameters = [means, torch.randn(2000, 4), torch.full((2000, 3), -4.5), torch.zeros(2000), torch.zeros(2000, 3)]
optimizer = torch.optim.Adam([parameter.requires_grad_() for parameter in parameters], lr=0.01)
for step in range(500):
    means, quats, scales, opacities, colors = parameters
    render, alpha, meta = globalsplat.rasterization(
        means, quats, scales.exp(), opacities.sigmoid(), colors.sigmoid(), viewmats, Ks, width, height
    )
    loss = (render[0] - image).abs().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if step % 100 == 99:
        print(f"step {step + 1}: mean absolute difference {loss.item():.4f}")
Image.fromarray((render[0].detach().clamp(0, 1) * 255).byte().numpy()).save(sys.argv[2])
