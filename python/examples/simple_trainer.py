"""gsplat's simple_trainer in fifty lines, on a CPU: python simple_trainer.py CAPTURE splat.ply [STEPS]

Uses gsplat's own densification (pip install gsplat), which reads the gradients of the projected means.
"""

import sys

import globalsplat
import torch
from gsplat.strategy import DefaultStrategy

STEPS = int(sys.argv[3]) if len(sys.argv) > 3 else 1500
SIDE, GAUSSIANS = 256, 20_000

capture = globalsplat.load_capture(sys.argv[1])
photos, viewmats, Ks = [], torch.from_numpy(capture.viewmats).float(), torch.from_numpy(capture.Ks).float()
for index in range(len(capture)):
    photo = torch.from_numpy(capture.image(index)).permute(2, 0, 1)[None].float() / 255.0
    factor = SIDE / max(photo.shape[2:])
    photos.append(torch.nn.functional.interpolate(photo, scale_factor=factor, mode="area")[0].permute(1, 2, 0))
    Ks[index, :2] *= factor

# COLMAP's points, or random ones in front of the cameras.
centers = viewmats.inverse()[:, :3, 3]
scale = (centers - centers.mean(0)).norm(dim=-1).max().item()
points, colors = (torch.from_numpy(array).float() for array in capture.points())
if len(points) == 0:
    points = centers.mean(0) + scale * torch.randn(GAUSSIANS, 3)
    colors = torch.rand(GAUSSIANS, 3)
rates = {"means": 2e-4 * scale, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 5e-3, "shN": 2.5e-4}
params = torch.nn.ParameterDict(
    {
        "means": points,
        "scales": torch.full_like(points, 0.02 * scale).log(),
        "quats": torch.randn(len(points), 4),
        "opacities": torch.full((len(points),), 0.1).logit(),
        "sh0": ((colors - 0.5) / 0.2820948)[:, None],
        "shN": torch.zeros(len(points), 3, 3),
    }
)
optimizers = {name: torch.optim.Adam([params[name]], lr=rate, eps=1e-15) for name, rate in rates.items()}
strategy = DefaultStrategy(refine_start_iter=200, refine_stop_iter=1000, reset_every=10_000)
state = strategy.initialize_state(scene_scale=scale)

for step in range(STEPS):
    index = int(torch.randint(len(photos), ()))
    height, width = photos[index].shape[:2]
    sh = torch.cat([params["sh0"], params["shN"]], 1)
    camera = viewmats[index : index + 1], Ks[index : index + 1], width, height
    opacities = params["opacities"].sigmoid()
    render, alpha, info = globalsplat.rasterization(
        params["means"], params["quats"], params["scales"].exp(), opacities, sh, *camera, sh_degree=1
    )
    strategy.step_pre_backward(params, optimizers, state, step, info)
    loss = (render[0] - photos[index]).abs().mean()
    loss.backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    strategy.step_post_backward(params, optimizers, state, step, info)
    if step % 100 == 99:
        print(f"step {step + 1}: loss {loss.item():.4f}, {len(params['means'])} Gaussians")
globalsplat.save_splat(sys.argv[2], params, activated=False)
