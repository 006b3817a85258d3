"""Reconstructs a splat from photos, and goes on with PyTorch alone: python refine_splat.py CAPTURE splat.ply [STEPS]"""

# %% A capture, and the network's splat of it.
import sys

import globalsplat
import torch

capture = globalsplat.load_capture(sys.argv[1])
splat = globalsplat.reconstruct(capture)
print(f"{capture}: {len(splat['means'])} Gaussians")

# %% Photos and cameras as tensors. The renders are differentiable with respect to both.
photos = [torch.from_numpy(capture.image(index)).float() / 255.0 for index in range(len(capture))]
viewmats, Ks = torch.from_numpy(capture.viewmats).float(), torch.from_numpy(capture.Ks).float()

# %% The parameters that are optimized: every real number is valid.
means, quats, colors = (splat[name].clone().requires_grad_() for name in ("means", "quats", "colors"))
log_scales = splat["scales"].log().requires_grad_()
logits = splat["opacities"].logit(1e-6).requires_grad_()
extent = (viewmats.inverse()[:, :3, 3] - viewmats.inverse()[0, :3, 3]).norm(dim=-1).max().item()
optimizer = torch.optim.Adam(
    [
        {"params": [means], "lr": 2e-4 * extent},
        {"params": [quats], "lr": 1e-3},
        {"params": [log_scales], "lr": 5e-3},
        {"params": [logits], "lr": 5e-2},
        {"params": [colors], "lr": 5e-3},
    ]
)


# %% One photo in every step.
def render(index):
    height, width = photos[index].shape[:2]
    image, *_ = globalsplat.rasterization(
        means,
        quats,
        log_scales.exp(),
        logits.sigmoid(),
        colors,
        viewmats[index : index + 1],
        Ks[index : index + 1],
        width,
        height,
        sh_degree=splat["sh_degree"],
        eps2d=splat["eps2d"],
    )
    return image[0]


for step in range(int(sys.argv[3]) if len(sys.argv) > 3 else 300):
    index = step % len(photos)
    loss = (render(index) - photos[index]).abs().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if step % 50 == 49:
        with torch.no_grad():
            errors = torch.stack([(render(i).clamp(0, 1) - photo).square().mean() for i, photo in enumerate(photos)])
        print(f"step {step + 1}: PSNR of the photos {(-10 * errors.log10()).mean():.2f} dB")

# %% Write it in any format that the extension names.
trained = {**splat, "means": means, "quats": quats, "scales": log_scales.exp(), "opacities": logits.sigmoid()}
globalsplat.save_splat(sys.argv[2], {**trained, "colors": colors})
