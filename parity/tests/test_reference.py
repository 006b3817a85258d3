"""Tests of the PyTorch reference against golden tensors, and of the parts without these against independent
computations.

Golden tensors are read from $GLOBALSPLAT_GOLDEN, or else from ../shared/golden next to the repository.
"""

import json
import math
import os
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from parity.reference import decoder, encoder, model, normalize, rotation, schedule, splat, tokens
from parity.reference.loss import consistency, decoder_regularization, frustum, lpips, mse, subsets

REPOSITORY = Path(__file__).resolve().parents[2]
torch.set_num_threads(1)

GOLDEN = Path(os.environ.get("GLOBALSPLAT_GOLDEN", REPOSITORY.parent / "shared" / "golden"))
OUTPUT_TOLERANCE = 1e-5
GRADIENT_TOLERANCE = 1e-4
# The gradient of mem_k.bias is zero in exact arithmetic, so only rounding error remains in float32. It is compared with
# the largest gradient of the case.
ZERO_TOLERANCE = 1e-5


def golden(name):
    if not GOLDEN.is_dir():
        pytest.skip(f"golden tensors: {GOLDEN} is missing; set GLOBALSPLAT_GOLDEN")
    return GOLDEN / name


def load(name):
    """Returns the tensors of a file in float64, in which the reference computes."""
    return {key: value.double() for key, value in load_file(golden(name)).items()}


def relative(ours, theirs):
    """Returns the relative L2 distance, in float64. With NaN, no comparison with a tolerance passes."""
    ours, theirs = ours.detach().double().flatten(), theirs.double().flatten()
    assert ours.shape == theirs.shape, f"{tuple(ours.shape)} values, expected {tuple(theirs.shape)}"
    return ((ours - theirs).norm() / theirs.norm().clamp(min=1e-30)).item()


def assert_close(what, ours, theirs, tolerance, record):
    error = relative(ours, theirs)
    record(what, f"{error:.2e}")
    assert error <= tolerance, f"{what}: relative L2 error {error:.2e}, tolerance {tolerance:.0e}"


# ---- scene normalization ---------------------------------------------------------------------------------------------


def test_scene_normalization(record_property):
    g = load("scene_normalization.safetensors")
    c2w, w2c, scale = normalize.normalize_scene(g["c2w"])
    assert_close("norm_c2w", c2w, g["norm_c2w"], OUTPUT_TOLERANCE, record_property)
    assert_close("norm_w2c", w2c, g["norm_w2c"], OUTPUT_TOLERANCE, record_property)
    assert_close("scene_scale", scale, g["scene_scale"], OUTPUT_TOLERANCE, record_property)
    c2w, _, scale = normalize.normalize_scene(g["c2w"][:1])
    assert_close("single_norm_c2w", c2w, g["single_norm_c2w"], OUTPUT_TOLERANCE, record_property)
    assert_close("single_scene_scale", scale, g["single_scene_scale"], OUTPUT_TOLERANCE, record_property)


# ---- losses ----------------------------------------------------------------------------------------------------------


def test_frustum_loss(record_property):
    g = load("frustum_loss.safetensors")
    means = g["means"].requires_grad_()
    size = 2.0 * g["intrinsic"][0, 0, :2, 2]  # the file has no image size; principal points are its centre
    width, height = int(size[0]), int(size[1])
    loss = frustum.frustum(means, g["w2c"], g["intrinsic"], height, width, g["max_depth"])
    loss.backward()
    assert_close("loss", loss, g["loss"], OUTPUT_TOLERANCE, record_property)
    assert_close("grad_means", means.grad, g["grad_means"], GRADIENT_TOLERANCE, record_property)


def test_sh_soft_cap(record_property):
    g = load("sh_softcap.safetensors")
    sh = g["sh"].requires_grad_()
    loss = decoder_regularization.sh_soft_cap(sh)
    loss.backward()
    assert_close("reg", loss, g["reg"], OUTPUT_TOLERANCE, record_property)
    assert_close("grad", sh.grad, g["grad"], GRADIENT_TOLERANCE, record_property)


def test_opacity_term_is_a_switch():
    raw = {
        "log_scale": torch.tensor([-4.0, 0.0]),
        "rotation": torch.tensor([0.5]),
        "sh": torch.tensor([0.0]),
        "opacity_logit": torch.tensor([-3.0, 1.0]),
    }
    sigmoid = [1 / (1 + math.exp(3.0)), 1 / (1 + math.exp(-1.0))]
    opacity = sum(sigmoid) / 2 + (1.0 - math.log(0.25)) ** 2 / 2
    others = math.log(20.0) ** 2 / 2 + 0.25 + math.log1p(math.exp(-5.0)) ** 2
    without = decoder_regularization.decoder_regularization(raw, with_opacity=False).item()
    with_it = decoder_regularization.decoder_regularization(raw).item()
    assert without == pytest.approx(1e-2 * others)
    assert with_it == pytest.approx(1e-2 * (others + opacity))


def test_mse():
    assert mse.mse(torch.tensor([[0.0, 1.0]]), torch.tensor([[1.0, 3.0]])).item() == 2.5


def lpips_params(network):
    """Returns small random weights of a network."""
    generator, inputs, params = torch.Generator().manual_seed(0), 3, {}
    for name, outputs, kernel, _, _ in (layer for row in lpips.NETWORKS[network] for layer in row):
        params[f"{name}.weight"] = 0.05 * torch.randn(outputs, inputs, kernel, kernel, generator=generator)
        params[f"{name}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
        if name in lpips.COMPARED[network]:
            at = lpips.COMPARED[network].index(name)
            params[f"lin{at}.weight"] = torch.rand(1, outputs, 1, 1, generator=generator)
        inputs = outputs
    return params


@pytest.mark.parametrize("network", lpips.NETWORKS)
def test_lpips(network):
    """LPIPS equals its definition, computed pixel by pixel on features of a sequence of PyTorch modules."""
    params = lpips_params(network)
    pictures = torch.rand(2, 3, 48, 40, generator=torch.Generator().manual_seed(1))
    found = lpips.lpips(network, params, pictures[:1], pictures[1:]).item()
    assert lpips.lpips(network, params, pictures[:1], pictures[:1]).item() == 0.0

    normalized = ((2 * pictures - 1).movedim(1, -1) - torch.tensor(lpips.SHIFT)) / torch.tensor(lpips.SCALE)
    x, expected = normalized.movedim(-1, 1), 0.0
    pools = {"lpips_vgg": torch.nn.MaxPool2d(2, 2), "lpips_alex": torch.nn.MaxPool2d(3, 2)}
    # Output channels of the convolutions in torchvision's `features` of both networks.
    rows = {
        "lpips_vgg": [(64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512)],
        "lpips_alex": [(64,), (192,), (384, 256, 256)],
    }[network]
    names = iter([name[: -len(".weight")] for name in params if name.startswith("conv") and name.endswith("weight")])
    compared = 0
    for i, row in enumerate(rows):
        x = pools[network](x) if i else x
        for j, channels in enumerate(row):
            name = next(names)
            weight = params[f"{name}.weight"]
            kernel = weight.shape[-1]
            stride, padding = (4, 2) if kernel == 11 else (1, kernel // 2)
            layer = torch.nn.Conv2d(x.shape[1], channels, kernel, stride, padding)
            with torch.no_grad():
                layer.weight.copy_(weight)
                layer.bias.copy_(params[f"{name}.bias"])
                x = layer(x).relu()
            if network == "lpips_alex" or j == len(row) - 1:
                linear, total = params[f"lin{compared}.weight"].flatten(), 0.0
                a, b = (picture.flatten(1).T / (picture.flatten(1).T.norm(dim=1)[:, None] + 1e-10) for picture in x)
                for ours, theirs in zip(a, b, strict=True):
                    total += (linear * (ours - theirs) ** 2).sum().item()
                expected += total / len(a)
                compared += 1
    assert compared == 5 and found == pytest.approx(expected, rel=1e-4)


def test_consistency():
    opacity_a = torch.tensor([0.9, 0.5, 0.005], requires_grad=True)
    opacity_b = torch.tensor([0.8, 0.7, 0.9], requires_grad=True)
    depth_a = torch.tensor([2.0, 1.0, 9.0], requires_grad=True)
    depth_b = torch.tensor([2.5, 4.0, 1.0], requires_grad=True)
    loss = consistency.consistency(opacity_a, opacity_b, depth_a, depth_b)
    assert loss.item() == pytest.approx(1e-3 * (0.1 + 0.2 + 0.895) / 3 + 1e-2 * (0.5 + 3.0) / 2)
    loss.backward()
    assert opacity_a.grad.tolist() == pytest.approx([0.5e-3 / 3, -0.5e-3 / 3, -0.5e-3 / 3])
    assert depth_a.grad.tolist() == pytest.approx([-0.5e-2 / 2, -0.5e-2 / 2, 0.0])
    assert depth_b.grad.tolist() == pytest.approx([0.5e-2 / 2, 0.5e-2 / 2, 0.0])
    nothing = torch.zeros(3)
    assert consistency.consistency(nothing, nothing, depth_a, depth_b).item() == 0.0


def test_subsets():
    assert subsets.subsets([5], 0) is None
    assert subsets.subsets([5, 3], 0) == ([1, 0], [1, 0])
    assert subsets.subsets([0, 1, 2, 3, 4, 5], 0) == ([0, 1, 3, 5], [0, 2, 4, 5])
    assert subsets.subsets([0, 1, 2, 3, 4, 5], 7) == ([0, 2, 4, 5], [0, 1, 3, 5])
    assert subsets.subsets([40, 0, 30, 10, 20], 0) == ([1, 3, 2, 0], [1, 4, 0, 0])
    a, b = subsets.subsets(list(range(24)), 0)
    assert len(a) == len(b) == 13 and len(set(a)) == len(set(b)) == 13


# ---- model -----------------------------------------------------------------------------------------------------------


def model_cases():
    found = sorted(path.parent.name for path in GOLDEN.glob("model_*/config.json"))
    return found or ["model_small"]  # this case is then skipped or fails, and is reported


def stage_cases():
    cases = []
    for case in model_cases():
        path = GOLDEN / case / "config.json"
        stages = json.loads(path.read_text())["stages"] if path.exists() else [[0, 1.0]]
        cases += [(case, int(s), float(mix)) for s, mix in stages]
    return cases


def load_model(case):
    config = json.loads(golden(f"{case}/config.json").read_text())
    return config, load(f"{case}/state.safetensors"), load(f"{case}/inputs.safetensors")


@pytest.mark.parametrize("case", model_cases())
def test_encoder(case, record_property):
    config, params, inputs = load_model(case)
    g = load(f"{case}/encoder.safetensors")
    content = tokens.view_tokens(config, params, inputs["images"], inputs["c2w"], inputs["intrinsic"])
    geo, app = encoder.encode(config, params, content)
    assert_close("content_tokens", content, g["content_tokens"], OUTPUT_TOLERANCE, record_property)
    assert_close("encoded_geo", geo, g["encoded_geo"], OUTPUT_TOLERANCE, record_property)
    assert_close("encoded_tex", app, g["encoded_tex"], OUTPUT_TOLERANCE, record_property)


@pytest.mark.parametrize("case, stage, mix", stage_cases())
def test_model(case, stage, mix, record_property):
    config, params, inputs = load_model(case)
    g = load(f"{case}/stage{stage}_mix{round(100 * mix):03d}.safetensors")
    constant = "gaussian_decoder.patch_center_bias"
    for name in params.keys() - {constant}:
        params[name].requires_grad_()
    images = inputs["images"].requires_grad_()

    out = model.forward(config, params, images, inputs["c2w"], inputs["intrinsic"], stage, mix)
    out["reg"] = decoder_regularization.decoder_regularization(out["raw"], with_opacity=False).reshape(1)
    expected = {key.removeprefix("out."): value for key, value in g.items() if key.startswith("out.")}
    assert expected.keys() == out.keys() - {"raw"}
    for key, value in expected.items():
        assert_close(f"out.{key}", out[key], value, OUTPUT_TOLERANCE, record_property)

    cotangents = {key.removeprefix("cotangent."): value for key, value in g.items() if key.startswith("cotangent.")}
    sum((value * out[key]).sum() for key, value in cotangents.items()).backward()

    gradients = {key.removeprefix("grad."): value for key, value in g.items() if key.startswith("grad.")}
    assert gradients.keys() == params.keys() - {constant}
    assert_close("grad images", images.grad, g["grad_input.images"], GRADIENT_TOLERANCE, record_property)
    largest = max(value.norm().item() for value in gradients.values())
    for name, value in gradients.items():
        if name.endswith("mem_k.bias"):
            ours = params[name].grad.norm().item() / largest
            record_property(f"grad {name}", f"{ours:.2e}")
            assert ours <= ZERO_TOLERANCE, f"grad {name}: {ours:.2e} of the largest gradient, expected 0"
        else:
            assert_close(f"grad {name}", params[name].grad, value, GRADIENT_TOLERANCE, record_property)


def test_ablations():
    """Without the camera code only the ray part of the tokens changes; a single stream uses no appearance weights."""
    config, params, inputs = load_model("model_small")
    full = tokens.view_tokens(config, params, inputs["images"], inputs["c2w"], inputs["intrinsic"])
    plucker_only = {name: value for name, value in params.items() if not name.startswith("view_pe.")}
    bare = tokens.view_tokens(
        config | {"camera_code": False}, plucker_only, inputs["images"], inputs["c2w"], inputs["intrinsic"]
    )
    width = config["dim_rays"]
    code = full[..., :width] - bare[..., :width]
    assert torch.equal(full[..., width:], bare[..., width:])
    assert torch.allclose(code, code[:, :, :1].expand_as(code), atol=1e-5) and code.abs().max() > 1e-3

    appearance = ("slot_encoder.slot_to_tex", "slot_encoder.tex_rounds", "slot_encoder.pair_adapters")
    one_stream = {name: value for name, value in params.items() if not name.startswith(appearance)}
    geo, app = encoder.encode(config | {"streams": "single"}, one_stream, full)
    assert torch.equal(geo, app) and geo.shape == (2, config["latent_rep_token_amount"], config["dim_latents"])


def small_decoder(log_scale, opacity):
    """Returns a decoder for one token and two candidates whose raw outputs are its biases."""
    config = {"M_max": 2, "sh_degree": 0}
    sizes = {"geo_pos_readout": 6, "geo_param_readout": 20, "sh_readout": 6, "gate_readout": 2}
    params = {"gaussian_decoder.patch_center_bias": torch.tensor([[[0.0, 0.0, 1.5]]])}
    for head, size in sizes.items():
        params[f"gaussian_decoder.{head}.weight"] = torch.zeros(size, 2)
        params[f"gaussian_decoder.{head}.bias"] = torch.zeros(size)
    bias = torch.tensor([[log_scale] * 3 + [0.0] * 6 + [opacity]] * 2).flatten().requires_grad_()
    params["gaussian_decoder.geo_param_readout.bias"] = bias
    return config, params, bias


@pytest.mark.parametrize(
    "log_scale, opacity, scale, alpha",
    [
        (0.0, 0.0, math.exp(-2.0), 1 / (1 + math.exp(5.0))),
        (0.0, 10.0, math.exp(-2.0), 0.99),  # sigmoid(5) is above the largest opacity
        (9.0, 50.0, 0.05 * math.exp(2.0), 0.99),
        (-20.0, -50.0, 1e-4 * math.exp(-1.0), 1 / (1 + math.exp(13.0))),
    ],
)
def test_decoder_clamps(log_scale, opacity, scale, alpha):
    config, params, bias = small_decoder(log_scale, opacity)
    out = decoder.decode(config, params, torch.zeros(1, 1, 2), torch.zeros(1, 1, 2), 1, 1.0)
    assert out["means"][0].tolist() == [[0.0, 0.0, 1.5]] * 2
    assert out["scales"].flatten().tolist() == pytest.approx([scale] * 6, rel=1e-5)
    assert out["opacities"].flatten().tolist() == pytest.approx([alpha] * 2, rel=1e-5)
    assert out["quats_wxyz"][0].tolist() == [[1.0, 0.0, 0.0, 0.0]] * 2
    assert torch.allclose(out["raw"]["log_scale"], torch.tensor(log_scale - 2.0))  # before the clamp
    out["opacities"].sum().backward()
    assert (bias.grad[9].item() == 0.0) == (opacity != 0.0)  # a clamp passes no gradient
    assert torch.isfinite(bias.grad).all()


def test_rotations():
    """The round trip 6D -> matrix -> quaternion -> matrix is exact for all four branches of the quaternion."""
    generator = torch.Generator().manual_seed(1)
    six = torch.randn(500, 6, generator=generator, dtype=torch.float64)
    half_turns = torch.tensor([[1, 0, 0, 0, -1, 0], [-1, 0, 0, 0, 1, 0], [-1, 0, 0, 0, -1, 0]], dtype=torch.float64)
    matrix = rotation.matrix_from_6d(torch.cat([six, half_turns]))
    assert torch.allclose(matrix @ matrix.transpose(-1, -2), torch.eye(3, dtype=torch.float64).expand_as(matrix))
    assert torch.allclose(torch.linalg.det(matrix), torch.ones(len(matrix), dtype=torch.float64))
    assert torch.allclose(matrix[:500, 0], six[:, :3] / six[:, :3].norm(dim=-1, keepdim=True))  # b1 is a row
    q = rotation.quaternion_from_matrix(matrix)
    assert torch.allclose(q.norm(dim=-1), torch.ones(len(q), dtype=torch.float64))
    assert (q[:, 0] >= 0).all()
    assert torch.allclose(rotation.matrix_from_quaternion(q), matrix)
    assert set(q.abs().argmax(-1).tolist()) == {0, 1, 2, 3}
    quarter = rotation.matrix_from_quaternion(torch.tensor([2.0, 0.0, 0.0, 2.0]))  # 90 degrees about z, not unit
    assert torch.allclose(quarter @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]), atol=1e-7)


# ---- schedule --------------------------------------------------------------------------------------------------------


def test_learning_rate():
    rate = [schedule.learning_rate(step, 220_000, 5e-4) for step in range(220_001)]
    assert rate[0] == pytest.approx(5e-7)
    assert rate[3300] == pytest.approx(5e-4 * (1e-3 + 0.999 / 2))
    assert rate[6600] == pytest.approx(5e-4) and max(rate) == rate[6600]
    assert rate[(6600 + 220_000) // 2] == pytest.approx((5e-4 + 1e-5) / 2)
    assert rate[220_000] == pytest.approx(1e-5)
    assert schedule.learning_rate(220_000, 220_000, 2e-5) == pytest.approx(1e-6)


def test_stage():
    table = {0: (0, 1.0), 9_999: (0, 1.0), 10_000: (1, 0.0), 11_000: (1, 0.5), 12_000: (1, 1.0), 19_999: (1, 1.0)}
    table |= {20_000: (2, 0.0), 49_999: (2, 1.0), 50_500: (3, 0.25), 52_000: (3, 1.0), 219_999: (3, 1.0)}
    for step, expected in table.items():
        assert schedule.stage(step, final_stage=3) == expected
    assert schedule.stage(60_000, final_stage=0) == (0, 1.0)
    assert schedule.stage(50_500, final_stage=2) == (2, 1.0)


def test_adamw_and_clipping_against_torch():
    generator = torch.Generator().manual_seed(0)
    start = {"layer.weight": torch.randn(4, 3, generator=generator), "layer.bias": torch.randn(4, generator=generator)}
    start["scene_tokens"] = torch.randn(5, 3, generator=generator)
    assert [schedule.is_decayed(name, p) for name, p in start.items()] == [True, False, False]
    theirs = {name: torch.nn.Parameter(p.clone()) for name, p in start.items()}
    optimizer = torch.optim.AdamW(
        [{"params": [p], "weight_decay": 0.1 if schedule.is_decayed(name, p) else 0.0} for name, p in theirs.items()],
        lr=1e-2,
    )
    ours = {name: (p, torch.zeros_like(p), torch.zeros_like(p)) for name, p in start.items()}
    for count in range(1, 6):
        gradients = {name: 3.0 * torch.randn(p.shape, generator=generator) for name, p in start.items()}
        for name, p in theirs.items():
            p.grad = gradients[name].clone()
        torch.nn.utils.clip_grad_norm_(theirs.values(), 1.0)
        optimizer.step()
        clipped, _ = schedule.clip_gradients(gradients)
        for name, (p, first, second) in ours.items():
            decay = 0.1 if schedule.is_decayed(name, p) else 0.0
            ours[name] = schedule.adamw_step(p, clipped[name], first, second, count, 1e-2, decay)
    for name in start:
        assert torch.allclose(ours[name][0], theirs[name], atol=1e-6)


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
            ours, mean = schedule.muon_step(ours, theirs.grad, mean, 0.1, 0.3)
        decayed = start * (1 - 0.1 * 0.3) ** 4
        assert (ours - theirs).norm() < 0.02 * (ours - decayed).norm()


# ---- rasterizer ------------------------------------------------------------------------------------------------------

WIDTH, HEIGHT = 9, 7


def camera(dtype=torch.float64):
    """Returns a rotated camera away from the origin, with unequal focal lengths and an off-centre principal point."""
    q = torch.tensor([0.95, 0.10, -0.25, 0.05], dtype=dtype)
    w2c = torch.eye(4, dtype=dtype)
    w2c[:3, :3] = rotation.matrix_from_quaternion(q)
    w2c[:3, 3] = torch.tensor([0.2, -0.1, 0.4], dtype=dtype)
    intrinsic = torch.tensor([[8.0, 0.0, 4.2], [0.0, 7.5, 3.1], [0.0, 0.0, 1.0]], dtype=dtype)
    return w2c, intrinsic


def scene(in_camera, scales, opacities, w2c, coefficients=16, seed=0):
    """Returns Gaussians at the given camera-space positions, with random unnormalized quaternions and SH."""
    generator = torch.Generator().manual_seed(seed)
    in_camera = torch.tensor(in_camera, dtype=torch.float64)
    n = len(in_camera)
    means = (in_camera - w2c[:3, 3]) @ w2c[:3, :3]
    scales = torch.tensor(scales, dtype=torch.float64)
    quaternions = 1.7 * torch.randn(n, 4, generator=generator, dtype=torch.float64)
    sh = 0.15 * torch.randn(n, coefficients, 3, generator=generator, dtype=torch.float64)
    return means, scales, quaternions, torch.tensor(opacities, dtype=torch.float64), sh


def scalar_render(means, scales, quaternions, opacities, sh, w2c, intrinsic, width, height, eps2d, antialiased):
    """Renders with scalar Python arithmetic and loops, one pixel and one Gaussian at a time."""
    n = len(means)
    means, scales, quaternions = means.tolist(), scales.tolist(), quaternions.tolist()
    opacities, sh, w2c, k = opacities.tolist(), sh.tolist(), w2c.tolist(), intrinsic.tolist()
    fx, fy, cx, cy = k[0][0], k[1][1], k[0][2], k[1][2]
    centre = [-sum(w2c[r][c] * w2c[r][3] for r in range(3)) for c in range(3)]

    def product(a, b):
        return [[sum(a[i][t] * b[t][j] for t in range(len(b))) for j in range(len(b[0]))] for i in range(len(a))]

    def transpose(a):
        return [list(column) for column in zip(*a, strict=True)]

    def hamilton(p, q):
        return (
            p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
        )

    def rotate(q, v):  # q v q*, which shares no formula with the code under test
        length = math.sqrt(sum(c * c for c in q))
        q = [c / length for c in q]
        return hamilton(hamilton(q, (0.0, *v)), (q[0], -q[1], -q[2], -q[3]))[1:]

    def basis(x, y, z):  # from the definition: real harmonics, in 3DGS's order and signs
        pi = math.pi
        first = math.sqrt(3 / (4 * pi))
        second = 0.5 * math.sqrt(15 / pi)
        return [
            0.5 * math.sqrt(1 / pi),
            -first * y, first * z, -first * x,
            second * x * y, -second * y * z, 0.25 * math.sqrt(5 / pi) * (3 * z * z - 1),
            -second * x * z, 0.5 * second * (x * x - y * y),
            -0.25 * math.sqrt(35 / (2 * pi)) * y * (3 * x * x - y * y), 0.5 * math.sqrt(105 / pi) * x * y * z,
            -0.25 * math.sqrt(21 / (2 * pi)) * y * (5 * z * z - 1), 0.25 * math.sqrt(7 / pi) * z * (5 * z * z - 3),
            -0.25 * math.sqrt(21 / (2 * pi)) * x * (5 * z * z - 1), 0.25 * math.sqrt(105 / pi) * z * (x * x - y * y),
            -0.25 * math.sqrt(35 / (2 * pi)) * x * (x * x - 3 * y * y),
        ]  # fmt: skip

    drawn = []
    for g in range(n):
        x, y, z = (sum(w2c[r][c] * means[g][c] for c in range(3)) + w2c[r][3] for r in range(3))
        if z <= 0.01:
            continue
        axes = transpose([rotate(quaternions[g], e) for e in ((1, 0, 0), (0, 1, 0), (0, 0, 1))])  # columns
        sigma3 = [
            [sum(axes[i][t] * scales[g][t] ** 2 * axes[j][t] for t in range(3)) for j in range(3)] for i in range(3)
        ]
        px = min(max(x / z, (-cx - 0.15 * width) / fx), (width - cx + 0.15 * width) / fx)
        py = min(max(y / z, (-cy - 0.15 * height) / fy), (height - cy + 0.15 * height) / fy)
        j = [[fx / z, 0.0, -fx * px / z], [0.0, fy / z, -fy * py / z]]
        jw = product(j, [row[:3] for row in w2c[:3]])
        cov = product(product(jw, sigma3), transpose(jw))
        a, b, c = cov[0][0] + eps2d, cov[0][1], cov[1][1] + eps2d
        det = a * c - b * b
        if det <= 0:
            continue
        area = cov[0][0] * cov[1][1] - b * b
        opacity = opacities[g] * (math.sqrt(max(area, 0.0) / det) if antialiased else 1.0)
        d = [means[g][t] - centre[t] for t in range(3)]
        length = math.sqrt(sum(t * t for t in d))
        values = basis(*(t / length for t in d))
        color = [max(0.0, 0.5 + sum(values[t] * sh[g][t][ch] for t in range(len(sh[g])))) for ch in range(3)]
        drawn.append((z, g, fx * x / z + cx, fy * y / z + cy, (c / det, -b / det, a / det), opacity, color))
    drawn.sort(key=lambda item: item[:2])

    images = torch.zeros(height, width, 5, dtype=torch.float64)
    for i in range(height):
        for column in range(width):
            remaining, rgb, depth = 1.0, [0.0, 0.0, 0.0], 0.0
            for z, _, u, v, (ca, cb, cc), opacity, color in drawn:
                dx, dy = u - (column + 0.5), v - (i + 0.5)
                alpha = min(0.999, opacity * math.exp(-0.5 * (ca * dx * dx + 2 * cb * dx * dy + cc * dy * dy)))
                if alpha < 1 / 255:
                    continue
                if remaining * (1 - alpha) <= 1e-4:
                    break
                for ch in range(3):
                    rgb[ch] += remaining * alpha * color[ch]
                depth += remaining * alpha * z
                remaining *= 1 - alpha
            accumulated = 1 - remaining
            expected = depth / accumulated if accumulated > 1e-10 else 0.0
            images[i, column] = torch.tensor([*rgb, accumulated, expected], dtype=torch.float64)
    return images[..., :3], images[..., 3], images[..., 4]


def crowded_scene(w2c, seed):
    """Returns a scene to which every rule of the rasterizer applies.

    It has Gaussians behind the camera and in front of the near plane, equal depths, opaque Gaussians in front of
    others, thin ones below a pixel, colors below zero, and positions far outside of the image.
    """
    generator = torch.Generator().manual_seed(seed)
    n = 60
    z = 0.2 + 4.0 * torch.rand(n, generator=generator, dtype=torch.float64)
    xy = 0.9 * (2.0 * torch.rand(n, 2, generator=generator, dtype=torch.float64) - 1.0) * z[:, None]
    in_camera = torch.cat([xy, z[:, None]], dim=-1)
    in_camera[:3, 2] = torch.tensor([-1.0, 0.0099, 0.0101], dtype=torch.float64)
    scales = torch.exp(torch.rand(n, 3, generator=generator, dtype=torch.float64) * 4.0 - 5.0)
    opacities = torch.rand(n, generator=generator, dtype=torch.float64)
    opacities[3:20] = 1.0
    scales[3:12] *= 4.0
    means, scales, quaternions, opacities, sh = scene(in_camera.tolist(), scales.tolist(), opacities.tolist(), w2c)
    means[30] = means[31]  # equal depth: the lower index is in front
    means[40] = means[39]
    return means, scales, quaternions, opacities, 4.0 * sh


@pytest.mark.parametrize("seed, antialiased", [(0, False), (1, False), (2, False), (0, True)])
def test_splat_against_scalar_loops(seed, antialiased):
    w2c, intrinsic = camera()
    values = crowded_scene(w2c, seed)
    ours = splat.render(*values, w2c, intrinsic, WIDTH, HEIGHT, antialiased=antialiased)
    theirs = scalar_render(*values, w2c, intrinsic, WIDTH, HEIGHT, splat.EPS_2D, antialiased)
    for name, a, b in zip(("rgb", "opacity", "depth"), ours, theirs, strict=True):
        assert (a - b).abs().max().item() < 1e-10, name
    values, w2c, intrinsic = [v.float() for v in values], w2c.float(), intrinsic.float()
    single = splat.render(*values, w2c, intrinsic, WIDTH, HEIGHT, antialiased=antialiased)
    assert single[0].dtype == torch.float32
    close = (single[0].double() - theirs[0]).abs().amax(-1) < 1e-4  # a threshold may go the other way at a pixel
    assert close.double().mean() > 0.95


def test_color_below_zero_is_black_without_gradient():
    w2c, _ = camera()
    sh = torch.tensor([[[-9.0, 0.3, 9.0]]], dtype=torch.float64, requires_grad=True)
    means = torch.tensor([[0.3, 0.2, 2.0]], dtype=torch.float64)
    color = splat.sh_color(means, sh, w2c)
    assert color[0, 0].item() == 0.0 and color[0, 2].item() == pytest.approx(0.5 + 9 * 0.28209479177387814)
    color.sum().backward()
    assert sh.grad[0, 0].tolist() == pytest.approx([0.0, 0.28209479177387814, 0.28209479177387814])


def test_capped_alphas_and_negative_colors_have_no_gradient():
    opacity = torch.tensor([1.0], dtype=torch.float64, requires_grad=True)
    centre = torch.full((1, 2), 0.5, dtype=torch.float64)
    projected = {"mean2d": centre, "conic": torch.tensor([[1.0, 0.0, 1.0]], dtype=torch.float64)}
    projected |= {"depth": torch.ones(1, dtype=torch.float64), "visible": torch.ones(1, dtype=torch.bool)}
    weight, _, _ = splat.composite(projected, opacity, torch.ones(1, 3, dtype=torch.float64), centre)
    weight.sum().backward()
    assert weight.tolist() == [[0.999] * 3] and opacity.grad.tolist() == [0.0]
    sh = torch.tensor([[[-9.0, 0.3, 9.0]]], dtype=torch.float64, requires_grad=True)
    color = splat.sh_color(torch.tensor([[0.3, 0.2, 2.0]], dtype=torch.float64), sh, camera()[0])
    assert color[0, 0].item() == 0.0 and color[0, 2].item() == pytest.approx(0.5 + 9 * 0.28209479177387814)
    color.sum().backward()
    assert sh.grad[0, 0].tolist() == pytest.approx([0.0, 0.28209479177387814, 0.28209479177387814])
