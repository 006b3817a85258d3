"""The splat op against gsplat's own implementation in PyTorch, and as a citizen of PyTorch."""

import itertools

import globalsplat
import gsplat_reference
import pytest
import torch

WIDTH, HEIGHT = 45, 37
# Maximum difference, relative to the largest value of a tensor.
TOLERANCE = 1e-4


def cameras(count, dtype):
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


def gaussians(kind, dtype, count=60):
    """Returns means, quats, scales, opacities of a scene."""
    generator = torch.Generator().manual_seed(7)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=dtype)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=dtype)

    count = 600 if kind == "crowded" else count
    means = normal(count, 3) * torch.tensor([1.2, 1.0, 0.8], dtype=dtype) + torch.tensor([0.0, 0.0, 4.0], dtype=dtype)
    scales = 0.03 + 0.3 * uniform(count, 3)
    if kind == "thin":
        scales = scales * torch.tensor([1.0, 0.02, 0.001], dtype=dtype)
    if kind == "behind":
        means = means * torch.tensor([1.0, 1.0, 2.0], dtype=dtype) - torch.tensor([0.0, 0.0, 8.0], dtype=dtype)
    return means, normal(count, 4), scales, uniform(count)


def leaves(tensors):
    return [tensor.detach().clone().requires_grad_() for tensor in tensors]


def compare(inputs, Ks, dtype, **options):
    """Compares images, alphas, meta and the gradients of all `inputs`. Pixels that rounding may decide are left out."""
    exact = [tensor.double() for tensor in inputs]
    near = [
        gsplat_reference.rasterization(*exact, Ks.double(), WIDTH, HEIGHT, threshold_factor=factor, **doubles(options))
        for factor in (1 - 1e-4, 1 + 1e-4)
    ]
    is_certain = ((near[0][0] - near[1][0]).abs().amax(-1) < 1e-7) & ((near[0][1] - near[1][1]).abs()[..., 0] < 1e-7)
    assert is_certain.float().mean() > 0.9
    results = []
    for render, kind in ((gsplat_reference.rasterization, torch.float64), (globalsplat.rasterization, dtype)):
        ours = leaves(tensor.to(kind) for tensor in inputs)
        image, alpha, meta = render(
            *ours, Ks.to(kind), WIDTH, HEIGHT, **{name: to(kind, value) for name, value in options.items()}
        )
        weights = (
            torch.randn(image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
            * is_certain[..., None]
        )
        alphas = (
            torch.randn(alpha.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
            * is_certain[..., None]
        )
        loss = (image * weights).sum() + (alpha * alphas).sum()
        tapped = [meta["means2d"]] if meta["means2d"].requires_grad else []
        gradients = torch.autograd.grad(loss, [*ours, *tapped])
        results.append((image * is_certain[..., None], alpha * is_certain[..., None], meta, gradients))
    (image, alpha, meta, gradients), ours = results
    assert_close("image", ours[0], image)
    assert_close("alpha", ours[1], alpha)
    is_visible = (meta["radii"] > 0).all(-1)
    assert is_visible.any()
    # Radii are rounded up to pixels, which a last bit may change.
    difference = (ours[2]["radii"] - meta["radii"]).abs()
    assert difference.max() <= 1 and (difference > 0).float().mean() < 0.01
    for name in ("means2d", "depths", "conics", "opacities"):
        assert_close(name, ours[2][name][is_visible], meta[name][is_visible])
    names = ["means", "quats", "scales", "opacities", "colors", "viewmats", "means2d"]
    for name, our, their in zip(names, ours[3], gradients, strict=True):
        if name == "viewmats":  # the last rows of matrices are constant
            our, their = our[:, :3], their[:, :3]
            if "sh_degree" in options:
                our, their = (rigid(gradient, inputs[-1]) for gradient in (our, their))
        assert_close(f"gradient of {name}", our, their)


def rigid(gradient, viewmats):
    """Returns the gradient with respect to rotations and translations of cameras.

    gsplat inverts matrices where this package transposes rotations, which is the same for rigid motions only.
    """
    rotations = gradient[:, :, :3].double() @ viewmats[:, :3, :3].double().transpose(1, 2)
    return torch.cat([rotations - rotations.transpose(1, 2), gradient[:, :, 3:].double()], -1)


def to(dtype, value):
    return value.to(dtype) if isinstance(value, torch.Tensor) else value


def doubles(options):
    return {name: to(torch.float64, value) for name, value in options.items()}


def assert_close(name, ours, theirs):
    assert ours.shape == theirs.shape, name
    difference = (ours.double() - theirs).abs().max() if ours.numel() else torch.tensor(0.0)
    scale = theirs.abs().max().clamp(min=1e-6) if ours.numel() else torch.tensor(1.0)
    assert difference <= TOLERANCE * scale, f"{name}: {difference:.2e} of {scale:.2e}"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["random", "thin", "crowded", "behind"])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_it_equals_gsplat_in_every_scene(kind, dtype, rasterize_mode):
    viewmats, Ks = cameras(3, dtype)
    scene = gaussians(kind, dtype)
    colors = torch.rand(len(scene[0]), 3, generator=torch.Generator().manual_seed(2), dtype=dtype)
    compare([*scene, colors, viewmats], Ks, dtype, render_mode="RGB+ED", rasterize_mode=rasterize_mode)


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_it_equals_gsplat_for_spherical_harmonics(sh_degree):
    viewmats, Ks = cameras(2, torch.float64)
    scene = gaussians("random", torch.float64)
    colors = 0.5 * torch.randn(len(scene[0]), 16, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    compare([*scene, colors, viewmats], Ks, torch.float64, sh_degree=sh_degree)


@pytest.mark.parametrize("channels", [1, 3, 4, 7])
@pytest.mark.parametrize("render_mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_it_equals_gsplat_for_features_depths_and_backgrounds(channels, render_mode):
    viewmats, Ks = cameras(2, torch.float64)
    scene = gaussians("random", torch.float64)
    # Features are not limited to positive numbers.
    colors = torch.randn(len(scene[0]), channels, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    backgrounds = torch.randn(2, channels, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    options = {
        "render_mode": render_mode,
        "backgrounds": backgrounds,
        "near_plane": 3.4,
        "far_plane": 4.9,
        "eps2d": 0.1,
    }
    if render_mode in ("D", "ED"):
        ours, theirs = (
            render(*scene, colors, viewmats, Ks, WIDTH, HEIGHT, **options)[0]
            for render in (globalsplat.rasterization, gsplat_reference.rasterization)
        )
        assert_close("depth", ours, theirs)
    else:
        compare([*scene, colors, viewmats], Ks, torch.float64, **options)


def test_batches_and_colours_of_each_camera_equal_separate_calls():
    viewmats, Ks = cameras(2, torch.float32)
    scenes = [list(gaussians("random", torch.float32)) for _ in range(6)]
    for index, scene in enumerate(scenes):
        scene[0] = scene[0] + 0.1 * index
    stacked = [torch.stack(tensors).unflatten(0, (2, 3)) for tensors in zip(*scenes, strict=True)]
    colors = torch.rand(2, 3, 2, 60, 4)
    batch = leaves([*stacked, colors, viewmats.expand(2, 3, -1, -1, -1)])
    image, alpha, meta = globalsplat.rasterization(
        *batch, Ks.expand(2, 3, -1, -1, -1), WIDTH, HEIGHT, render_mode="RGB+D"
    )
    assert image.shape == (2, 3, 2, HEIGHT, WIDTH, 5) and alpha.shape == (2, 3, 2, HEIGHT, WIDTH, 1)
    assert meta["means2d"].shape == (2, 3, 2, 60, 2) and meta["radii"].shape == (2, 3, 2, 60, 2)
    image.square().sum().backward()
    for row, column in itertools.product(range(2), range(3)):
        parts = [leaves(tensor[row, column] for tensor in batch) for _ in range(2)]
        for camera, part in enumerate(parts):
            one, _, _ = globalsplat.rasterization(
                *part[:4],
                part[4][camera],
                part[5][camera : camera + 1],
                Ks[camera : camera + 1],
                WIDTH,
                HEIGHT,
                render_mode="RGB+D",
            )
            torch.testing.assert_close(one[0], image[row, column, camera], rtol=0, atol=0)
            one.square().sum().backward()
        for whole, first, second in zip(batch, *parts, strict=True):
            torch.testing.assert_close(whole.grad[row, column], first.grad + second.grad, rtol=1e-4, atol=1e-3)


def small_call(dtype=torch.float64, bases=1):
    """Returns arguments of the op for a small scene with its settings."""
    viewmats, Ks = cameras(2, dtype)
    scene = gaussians("random", dtype, 12)
    colors = torch.rand(12, bases, 3, generator=torch.Generator().manual_seed(2), dtype=dtype)
    tensors = [tensor[None].clone().requires_grad_() for tensor in (*scene, colors, viewmats)]
    return [*tensors, Ks[None], 12, 9, 0.3, 0.01, 1e10, False, bases == 1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bases", [1, 4])
def test_the_ops_pass_opcheck(dtype, bases):
    arguments = small_call(dtype, bases)
    means2d = torch.zeros(1, 2, 12, 2, dtype=dtype, requires_grad=True)
    torch.library.opcheck(torch.ops.globalsplat.splat, (*arguments, means2d))
    torch.library.opcheck(torch.ops.globalsplat.splat, (*arguments, None))
    torch.library.opcheck(torch.ops.globalsplat.project, arguments)


def test_gradients_pass_gradcheck():
    viewmats, Ks = cameras(2, torch.float64)
    inputs = leaves([*gaussians("random", torch.float64, 5), torch.rand(5, 2, dtype=torch.float64), viewmats[:, :3]])

    def render(means, quats, scales, opacities, colors, rows):
        matrices = torch.cat([rows, viewmats[:, 3:]], 1)
        image, alpha, _ = globalsplat.rasterization(
            means, quats, scales, 0.9 * opacities + 0.05, colors, matrices, Ks / 4, 9, 8, render_mode="RGB+ED"
        )
        return image, alpha

    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-4, rtol=1e-3)


def test_compiled_functions_give_the_same_bits():
    viewmats, Ks = cameras(2, torch.float32)
    scene = leaves([*gaussians("random", torch.float32), torch.rand(60, 3)])

    def loss(means, quats, scales, opacities, colors):
        image, alpha, _ = globalsplat.rasterization(
            means, quats, scales.exp() - 1, opacities, colors, viewmats, Ks, WIDTH, HEIGHT
        )
        return image.square().mean() + alpha.mean()

    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    eager = torch.autograd.grad(loss(*scene), scene)
    for ours, theirs in zip(torch.autograd.grad(compiled(*scene), scene), eager, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0)


def test_it_has_no_second_derivatives():
    viewmats, Ks = cameras(1, torch.float64)
    scene = leaves([*gaussians("random", torch.float64), torch.rand(60, 3, dtype=torch.float64)])
    image, _, _ = globalsplat.rasterization(*scene, viewmats, Ks, WIDTH, HEIGHT)
    (gradient,) = torch.autograd.grad(image.square().sum(), scene[:1], create_graph=True)
    with pytest.raises(RuntimeError, match="can't be differentiated twice"):
        gradient.sum().backward()


def test_radii_of_needles_are_those_of_float64():
    viewmats, Ks = torch.eye(4)[None], torch.tensor([[[300.0, 0.0, 150.0], [0.0, 300.0, 100.0], [0.0, 0.0, 1.0]]])
    quats = torch.tensor([[0.9238795, 0.0, 0.0, 0.3826834]])
    for length in (1.0, 20.0, 200.0):
        scene = [
            torch.tensor([[0.0, 0.0, 5.0]]),
            quats,
            torch.tensor([[length, 1e-3, 1e-3]]),
            torch.ones(1),
            torch.rand(1, 3),
        ]
        radii = [
            globalsplat.rasterization(*(tensor.to(dtype) for tensor in (*scene, viewmats, Ks)), 300, 200)[2]["radii"]
            for dtype in (torch.float32, torch.float64)
        ]
        assert ((radii[0] - radii[1]).abs() <= 1 + 1e-4 * radii[1]).all() and (radii[1] > 100).all()


def test_saved_tensors_may_be_moved():
    viewmats, Ks = cameras(1, torch.float32)
    scene = leaves([*gaussians("random", torch.float32), torch.rand(60, 3)])

    def gradients():
        image, _, _ = globalsplat.rasterization(*scene, viewmats, Ks, WIDTH, HEIGHT)
        return torch.autograd.grad(image.square().sum(), scene)

    expected = gradients()
    # Every saved tensor is copied, and with it the op's own state is lost.
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: tensor.clone(), lambda tensor: tensor):
        copied = gradients()
    for ours, theirs in zip(copied, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0)


def test_fake_tensors_have_the_shapes_of_real_ones():
    from torch._subclasses import FakeTensorMode

    viewmats, Ks = cameras(2, torch.float32)
    scene = [*gaussians("random", torch.float32), torch.rand(60, 5)]
    real = globalsplat.rasterization(*scene, viewmats, Ks, WIDTH, HEIGHT, render_mode="RGB+D")
    with FakeTensorMode() as mode:
        fakes = [mode.from_tensor(tensor) for tensor in (*scene, viewmats, Ks)]
        fake = globalsplat.rasterization(*fakes, WIDTH, HEIGHT, render_mode="RGB+D")
    for ours, theirs in zip(fake[:2], real[:2], strict=True):
        assert ours.shape == theirs.shape and ours.dtype == theirs.dtype


def test_half_precision_renders_in_float32():
    viewmats, Ks = cameras(1, torch.float32)
    scene = [tensor.half().requires_grad_() for tensor in (*gaussians("random", torch.float32), torch.rand(60, 3))]
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


@pytest.mark.parametrize(
    "options",
    [
        {"absgrad": True},
        {"sparse_grad": True},
        {"radius_clip": 1.0},
        {"camera_model": "fisheye"},
        {"with_ut": True},
        {"distributed": True},
        {"covars": torch.eye(3).repeat(60, 1, 1)},
        {"radial_coeffs": torch.zeros(1, 6)},
    ],
)
def test_arguments_that_are_not_implemented_are_refused(options):
    viewmats, Ks = cameras(1, torch.float32)
    with pytest.raises(NotImplementedError, match=next(iter(options))):
        globalsplat.rasterization(
            *gaussians("random", torch.float32), torch.rand(60, 3), viewmats, Ks, WIDTH, HEIGHT, **options
        )


def test_wrong_shapes_are_named():
    viewmats, Ks = cameras(1, torch.float32)
    means, quats, scales, opacities = gaussians("random", torch.float32)
    colors = torch.rand(60, 3)
    with pytest.raises(ValueError, match=r"scales has shape \[59, 3\], expected \[60, 3\]"):
        globalsplat.rasterization(means, quats, scales[1:], opacities, colors, viewmats, Ks, WIDTH, HEIGHT)
    with pytest.raises(ValueError, match=r"Ks has shape \[3, 3\], expected \[1, 3, 3\]"):
        globalsplat.rasterization(means, quats, scales, opacities, colors, viewmats, Ks[0], WIDTH, HEIGHT)
    with pytest.raises(ValueError, match="render_mode"):
        globalsplat.rasterization(
            means, quats, scales, opacities, colors, viewmats, Ks, WIDTH, HEIGHT, render_mode="rgb"
        )
    for name, options in {
        "width": {"width": 0},
        "eps2d": {"eps2d": -1.0},
        "far_plane": {"far_plane": float("nan")},
        "near_plane": {"near_plane": -1.0},
        "sh_degree": {"sh_degree": -2},
    }.items():
        every = {"width": WIDTH, "height": HEIGHT, **options}
        with pytest.raises(ValueError, match=f"{name} is .*, expected"):
            globalsplat.rasterization(means, quats, scales, opacities, torch.rand(60, 4, 3), viewmats, Ks, **every)
    with pytest.raises(NotImplementedError, match="degree 3"):
        globalsplat.rasterization(
            means, quats, scales, opacities, torch.rand(60, 25, 3), viewmats, Ks, WIDTH, HEIGHT, sh_degree=4
        )
