"""The splat op against the reference rasterizer, which the parity checks compare the program with, and as an op of PyTorch."""

import itertools
import math

import globalsplat
import pytest
import torch
import torch.utils.checkpoint
from globalsplat.reference import splat as reference

WIDTH, HEIGHT = 45, 37
# Maximum difference in float64, relative to the largest value of a tensor. The parity checks compare float32.
TOLERANCE = 1e-7


def cameras(count, dtype=torch.float64):
    """Returns cameras around the z axis that look at (0, 0, 4): viewmats and Ks."""
    generator = torch.Generator().manual_seed(1)
    viewmats = torch.eye(4, dtype=dtype).repeat(count, 1, 1)
    for index in range(1, count):
        turn = 0.3 * torch.randn(3, generator=generator, dtype=dtype)
        skew = torch.zeros(3, 3, dtype=dtype)
        skew[0, 1], skew[0, 2], skew[1, 2] = -turn[2], turn[1], -turn[0]
        viewmats[index, :3, :3] = torch.matrix_exp(skew - skew.T)
        target = torch.tensor([0.0, 0.0, 4.0], dtype=dtype)
        viewmats[index, :3, 3] = target - viewmats[index, :3, :3] @ target
    Ks = torch.tensor([[40.0, 0.0, 21.0], [0.0, 42.0, 19.5], [0.0, 0.0, 1.0]], dtype=dtype).repeat(count, 1, 1)
    return viewmats, Ks


def gaussians(dtype=torch.float64, count=60):
    """Returns means, quats, scales, opacities of a scene."""
    generator = torch.Generator().manual_seed(7)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=dtype)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=dtype)

    means = normal(count, 3) * torch.tensor([1.2, 1.0, 0.8], dtype=dtype) + torch.tensor([0.0, 0.0, 4.0], dtype=dtype)
    return means, normal(count, 4), 0.03 + 0.3 * uniform(count, 3), uniform(count)


def normals(seed, *shape):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def leaves(tensors):
    return [tensor.detach().clone().requires_grad_() for tensor in tensors]


def reference_rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, *, near_plane=0.01, far_plane=1e10, eps2d=0.3, sh_degree=None,
    backgrounds=None, render_mode="RGB", rasterize_mode="classic",
):  # fmt: skip
    """Returns images and alphas of the reference, and the projected Gaussians of each camera, with the conventions of `rasterization`."""
    images, alphas, cameras = [], [], []
    for camera, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        is_antialiased = rasterize_mode == "antialiased"
        projected = reference.project(means, scales, quats, viewmat, K, WIDTH, HEIGHT, eps2d, is_antialiased)
        projected["visible"] &= (projected["depth"] > near_plane) & (projected["depth"] < far_plane)
        cameras.append({**projected, "opacity": opacities * projected["compensation"]})
        bases = None if sh_degree is None else (sh_degree + 1) ** 2
        seen = colors if bases is None else reference.sh_color(means, colors[:, :bases], viewmat)
        pixels = reference.pixel_centers(WIDTH, HEIGHT, means.dtype)
        image, alpha, depth = reference.composite(projected, cameras[-1]["opacity"], seen, pixels)
        if backgrounds is not None:
            image = image + (1.0 - alpha[:, None]) * backgrounds[camera]
        depth = depth if render_mode.endswith("ED") else depth * alpha
        parts = {"RGB": image, "D": depth[:, None], "ED": depth[:, None]}
        images.append(torch.cat([parts[part] for part in render_mode.split("+")], -1).reshape(HEIGHT, WIDTH, -1))
        alphas.append(alpha.reshape(HEIGHT, WIDTH, 1))
    return torch.stack(images), torch.stack(alphas), cameras


def assert_close(name, ours, theirs):
    assert ours.shape == theirs.shape, name
    difference, scale = (ours - theirs).abs().max(), theirs.abs().max().clamp(min=1e-6)
    assert difference <= TOLERANCE * scale, f"{name}: {difference:.2e} of {scale:.2e}"


def compare(inputs, Ks, **options):
    """Compares images, alphas, projected Gaussians and all gradients."""
    expected, ours = leaves(inputs), leaves(inputs)
    theirs = reference_rasterization(*expected, Ks, **options)
    image, alpha, meta = globalsplat.rasterization(*ours, Ks, WIDTH, HEIGHT, **options)
    assert_close("image", image, theirs[0])
    assert_close("alpha", alpha, theirs[1])
    is_visible = (meta["radii"] > 0).all(-1)
    assert is_visible.any()
    for name, key in {"means2d": "mean2d", "conics": "conic", "depths": "depth", "opacities": "opacity"}.items():
        assert_close(name, meta[name][is_visible], torch.stack([camera[key] for camera in theirs[2]])[is_visible])
    weights = normals(3, *image.shape), normals(4, *alpha.shape)
    gradients = [
        torch.autograd.grad((image * weights[0]).sum() + (alpha * weights[1]).sum(), tensors)
        for image, alpha, tensors in (
            (image, alpha, [*ours, meta["means2d"]]),
            (*theirs[:2], [*expected, *(camera["mean2d"] for camera in theirs[2])]),
        )
    ]
    assert_close("gradient of means2d", gradients[0][6], torch.stack(gradients[1][6:]))
    names = ["means", "quats", "scales", "opacities", "colors", "viewmats"]
    for name, our, their in zip(names, *(found[:6] for found in gradients), strict=True):
        if name == "viewmats":  # the last rows of matrices are constant
            our, their = our[:, :3], their[:, :3]
        assert_close(f"gradient of {name}", our, their)


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_renders_equal_the_reference(rasterize_mode):
    viewmats, Ks = cameras(3)
    compare([*gaussians(), normals(2, 60, 3).abs(), viewmats], Ks, render_mode="RGB+ED", rasterize_mode=rasterize_mode)


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_spherical_harmonics_equal_the_reference(sh_degree):
    viewmats, Ks = cameras(2)
    compare([*gaussians(), 0.5 * normals(2, 60, 16, 3), viewmats], Ks, sh_degree=sh_degree)


@pytest.mark.parametrize("channels, render_mode", [(1, "RGB"), (4, "RGB+D"), (7, "RGB+ED")])
def test_features_depths_and_backgrounds_equal_the_reference(channels, render_mode):
    viewmats, Ks = cameras(2)
    inputs = [*gaussians(), normals(2, 60, channels), viewmats]
    options = {"near_plane": 3.4, "far_plane": 4.9, "eps2d": 0.1, "backgrounds": normals(5, 2, channels)}
    compare(inputs, Ks, render_mode=render_mode, **options)
    del options["backgrounds"]
    for mode in ("D", "ED"):
        one_channel = {"backgrounds": normals(5, 2, 1), "render_mode": mode}
        ours, _, _ = globalsplat.rasterization(*inputs, Ks, WIDTH, HEIGHT, **one_channel, **options)
        assert_close("depth", ours, reference_rasterization(*inputs, Ks, render_mode=mode, **options)[0])


def test_batches_and_colors_of_each_camera_equal_separate_calls():
    viewmats, Ks = cameras(2, torch.float32)
    scenes = [list(gaussians(torch.float32)) for _ in range(3)]
    for index, scene in enumerate(scenes):
        scene[0] = scene[0] + 0.1 * index
    stacked = [torch.stack(tensors) for tensors in zip(*scenes, strict=True)]
    batch = leaves([*stacked, torch.rand(3, 2, 60, 4), viewmats.expand(3, -1, -1, -1)])
    image, alpha, meta = globalsplat.rasterization(*batch, Ks.expand(3, -1, -1, -1), WIDTH, HEIGHT, render_mode="RGB+D")
    assert image.shape == (3, 2, HEIGHT, WIDTH, 5) and alpha.shape == (3, 2, HEIGHT, WIDTH, 1)
    assert meta["means2d"].shape == (3, 2, 60, 2) and meta["radii"].shape == (3, 2, 60, 2)
    for row, camera in itertools.product(range(3), range(2)):
        *scene, colors, matrices = (tensor[row] for tensor in batch)
        one_camera = colors[camera], matrices[camera : camera + 1], Ks[:1]
        one, _, _ = globalsplat.rasterization(*scene, *one_camera, WIDTH, HEIGHT, render_mode="RGB+D")
        torch.testing.assert_close(one[0], image[row, camera], rtol=0, atol=0)


@pytest.mark.parametrize("dtype, bases", [(torch.float32, 4), (torch.float64, 1)])
def test_the_ops_pass_opcheck(dtype, bases):
    viewmats, Ks = cameras(2, dtype)
    tensors = [*gaussians(dtype, 12), torch.rand(12, bases, 3, dtype=dtype), viewmats]
    tensors = [tensor[None].clone().requires_grad_() for tensor in tensors]
    arguments = [*tensors, Ks[None], 12, 9, 0.3, 0.01, 1e10, False, bases == 1]
    means2d = torch.zeros(1, 2, 12, 2, dtype=dtype, requires_grad=True)
    torch.library.opcheck(torch.ops.globalsplat.splat, (*arguments, means2d))
    torch.library.opcheck(torch.ops.globalsplat.splat, (*arguments, None))
    torch.library.opcheck(torch.ops.globalsplat.project, arguments)


def test_compiled_functions_give_the_same_bits():
    viewmats, Ks = cameras(2, torch.float32)
    scene = leaves([*gaussians(torch.float32), torch.rand(60, 3)])

    def loss(means, quats, scales, opacities, colors, width):
        image, alpha, _ = globalsplat.rasterization(
            means, quats, scales.exp() - 1, opacities, colors, viewmats, Ks, width, HEIGHT
        )
        return image.square().mean() + alpha.mean()

    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager", dynamic=True)
    eager = torch.autograd.grad(loss(*scene, WIDTH), scene)
    for ours, theirs in zip(torch.autograd.grad(compiled(*scene, WIDTH), scene), eager, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0)


def test_saved_tensors_may_be_moved_and_second_derivatives_are_refused():
    viewmats, Ks = cameras(1, torch.float32)
    scene = leaves([*gaussians(torch.float32), torch.rand(60, 3)])

    def gradients(**options):
        image, _, _ = globalsplat.rasterization(*scene, viewmats, Ks, WIDTH, HEIGHT)
        return torch.autograd.grad(image.square().sum(), scene, **options)

    expected = gradients()
    # Every saved tensor is copied, and with it the op's own state is lost.
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: tensor.clone(), lambda tensor: tensor):
        copied = gradients()
    for ours, theirs in zip(copied, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0)
    with pytest.raises(RuntimeError, match="can't be differentiated twice"):
        gradients(create_graph=True)[0].sum().backward()


@pytest.mark.parametrize("use_reentrant", [True, False])
def test_checkpointed_calls_give_the_same_gradients(use_reentrant):
    viewmats, Ks = cameras(1, torch.float32)
    scene = leaves([*gaussians(torch.float32), torch.rand(60, 3)])

    def image(*tensors):
        return globalsplat.rasterization(*tensors, viewmats, Ks, WIDTH, HEIGHT)[0]

    expected = torch.autograd.grad(image(*scene).square().sum(), scene)
    torch.utils.checkpoint.checkpoint(image, *scene, use_reentrant=use_reentrant).square().sum().backward()
    for tensor, theirs in zip(scene, expected, strict=True):
        torch.testing.assert_close(tensor.grad, theirs, rtol=0, atol=0)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "viewmats", "Ks"])
@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_make_results_nan(name, number):
    viewmats, Ks = cameras(2, torch.float32)
    means, quats, scales, opacities = gaussians(torch.float32)
    scene = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": torch.rand(60, 3)}
    batch = {key: torch.stack([value, value]) for key, value in {**scene, "viewmats": viewmats, "Ks": Ks}.items()}
    batch[name][1, 1].view(-1)[0] = number
    tensors = {key: value.requires_grad_(key != "Ks") for key, value in batch.items()}
    image, alpha, meta = globalsplat.rasterization(**tensors, width=WIDTH, height=HEIGHT, render_mode="RGB+ED")
    of_camera = name in ("viewmats", "Ks")
    is_nan = torch.tensor([[False, False], [not of_camera, True]])  # of each scene's cameras
    meta["means2d"].retain_grad()
    (image.sum() + alpha.sum()).backward()
    results = [image, alpha, batch["viewmats"].grad, meta["means2d"].grad]
    for result in results:
        assert result[is_nan].isnan().all() and result[~is_nan].isfinite().all()
    for key in scene:
        assert batch[key].grad[0].isfinite().all() and batch[key].grad[1].isnan().all(), key


@pytest.mark.parametrize("sh_degree", [None, 0])
def test_colors_that_are_nan_are_seen_and_large_numbers_are_not_nan(sh_degree):
    viewmats, Ks = cameras(1, torch.float32)
    means, quats, scales, opacities = gaussians(torch.float32)
    means[:9] = 3e38  # their sum is infinite
    colors = torch.full((60, 3) if sh_degree is None else (60, 1, 3), math.nan)
    image, alpha, _ = globalsplat.rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, WIDTH, HEIGHT, sh_degree=sh_degree
    )
    assert alpha.isfinite().all() and alpha.any()
    assert (image.isnan() | (alpha == 0)).all()


def test_half_precision_renders_in_float32():
    viewmats, Ks = cameras(1, torch.float32)
    scene = [tensor.half().requires_grad_() for tensor in (*gaussians(torch.float32), torch.rand(60, 3))]
    image, _, _ = globalsplat.rasterization(*scene, viewmats, Ks, WIDTH, HEIGHT)
    assert image.dtype == torch.float32
    image.sum().backward()
    assert all(tensor.grad.dtype == torch.float16 for tensor in scene)


def test_no_gaussians_render_the_background():
    viewmats, Ks = cameras(1, torch.float32)
    empty = [torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 3)]
    image, alpha, _ = globalsplat.rasterization(
        *empty, viewmats, Ks, WIDTH, HEIGHT, backgrounds=torch.tensor([[0.1, 0.2, 0.3]])
    )
    assert (image == torch.tensor([0.1, 0.2, 0.3])).all() and (alpha == 0).all()


def test_invalid_arguments_are_named():
    viewmats, Ks = cameras(1, torch.float32)
    means, quats, scales, opacities = gaussians(torch.float32)
    arguments = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    arguments |= {"colors": torch.rand(60, 4, 3), "viewmats": viewmats, "Ks": Ks, "width": WIDTH, "height": HEIGHT}
    for error, match, options in [
        (NotImplementedError, "absgrad", {"absgrad": True}),
        (NotImplementedError, "camera_model", {"camera_model": "fisheye"}),
        (NotImplementedError, "degree 3", {"sh_degree": 4}),
        (ValueError, r"scales has shape \[59, 3\], expected \[60, 3\]", {"scales": scales[1:]}),
        (ValueError, r"Ks has shape \[3, 3\], expected \[1, 3, 3\]", {"Ks": Ks[0]}),
        (ValueError, r"viewmats has shape \[4, 4\], expected \[C, 4, 4\]", {"viewmats": viewmats[0], "Ks": Ks[0]}),
        (ValueError, r"means has shape \[3\], expected \[N, 3\]", {"means": means[0]}),
        (ValueError, r"colors has shape \[60, 3\], expected \[60, K, 3\]", {"colors": torch.rand(60, 3)}),
        (ValueError, r"backgrounds has shape \[1, 1\], expected \[1, 3\]", {"backgrounds": torch.rand(1, 1)}),
        (ValueError, "the type of means is ndarray, expected Tensor", {"means": means.numpy()}),
        (ValueError, "the type of backgrounds is float, expected Tensor", {"backgrounds": 1.0}),
        (ValueError, "width is 640.0, expected an integer, 1 or more", {"width": 640.0}),
        (ValueError, "tile_size is 0, expected an integer, 1 or more", {"tile_size": 0}),
        (ValueError, "sh_degree is 1.0, expected an integer, 0 or more", {"sh_degree": 1.0}),
        (ValueError, "eps2d is inf, expected", {"eps2d": math.inf}),
        (ValueError, "render_mode is .*, expected", {"render_mode": "rgb"}),
        (ValueError, "width is .*, expected", {"width": 0}),
        (ValueError, "far_plane is .*, expected", {"far_plane": float("nan")}),
    ]:
        with pytest.raises(error, match=match):
            globalsplat.rasterization(**{"sh_degree": 1, **arguments, **options})
