"""The package as a user has it: its program, splats, captures, reconstruction, refinement and the model in PyTorch."""

import importlib.metadata
import math
import os
import platform
import subprocess
import sys
import tomllib
from pathlib import Path

import globalsplat
import numpy as np
import pytest
import torch
from globalsplat import _requirements
from globalsplat.reference.normalize import normalize_scene
from globalsplat.reference.splat import sh_color
from PIL import Image

# Formats, and the PSNR in dB that a render may lose in each. A .splat has one color of each Gaussian, and is compared with the mean colors.
FORMATS = {"ply": 0.01, "compressed.ply": 0.3, "sog": 0.3, "spz": 0.3, "splat": 0.3, "glb": 0.01}


def run(*command, **options):
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


@pytest.fixture(scope="module")
def splat(capture_folder):
    return globalsplat.reconstruct(capture_folder)


@pytest.fixture(scope="module")
def capture(capture_folder):
    return globalsplat.load_capture(capture_folder)


def render(splat, capture, index=0):
    """Returns a render of the splat from a camera of the capture, and the photo, both [H, W, 3]."""
    width, height = capture.sizes[index]
    viewmats, Ks = (
        torch.from_numpy(matrices[index : index + 1]).float() for matrices in (capture.viewmats, capture.Ks)
    )
    tensors = {name: torch.as_tensor(value) if hasattr(value, "shape") else value for name, value in splat.items()}
    image, _, _ = globalsplat.rasterization(**tensors, viewmats=viewmats, Ks=Ks, width=width, height=height)
    return image[0].clamp(0.0, 1.0), torch.from_numpy(capture.image(index)).float() / 255.0


def psnr(image, photo):
    return -10.0 * torch.log10((image - photo).square().mean()).item()


def with_mean_colors(splat, capture):
    """Returns the splat with the mean of each Gaussian's colors toward the cameras of the capture, from 0 to 1."""
    viewmats = torch.from_numpy(capture.viewmats).float()
    colors = torch.stack([sh_color(splat["means"], splat["colors"], viewmat) for viewmat in viewmats]).mean(0)
    return {**splat, "colors": (colors.clamp(max=1.0) - 0.5)[:, None] * math.sqrt(4 * math.pi), "sh_degree": 0}


def test_the_program_runs_on_the_installed_torch(tmp_path):
    for command in ([f"{sys.prefix}/bin/globalsplat"], [sys.executable, "-m", "globalsplat"]):
        doctor = run(*command, "doctor", cwd=tmp_path)
        assert doctor.returncode == 0, doctor.stderr
        assert torch.__version__.split("+")[0] in doctor.stdout
    mistake = run(f"{sys.prefix}/bin/globalsplat", "reconstruct", cwd=tmp_path)
    assert mistake.returncode == 2 and "--out" in mistake.stderr


def test_the_program_finds_a_torch_elsewhere(tmp_path):
    packages = Path(globalsplat.__file__).parent.parent
    other = tmp_path / "packages"
    other.mkdir()
    for package in packages.glob("globalsplat*"):
        (other / package.name).symlink_to(package)
    # The package is copied in front of the one with PyTorch beside it.
    (other / "globalsplat").unlink()
    run("cp", "-r", str(packages / "globalsplat"), str(other))
    code = "import sys; sys.argv[1:] = ['doctor']; from globalsplat._program import main; main()"
    doctor = run(sys.executable, "-c", code, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(other)})
    assert doctor.returncode == 0, doctor.stderr


def test_another_torch_is_refused_before_anything_is_loaded(tmp_path):
    packages = tmp_path / "packages"
    (packages / "torch").mkdir(parents=True)
    (packages / "torch" / "__init__.py").write_text("raise RuntimeError('it was imported')\n")
    (packages / "torch-2.10.0.dist-info").mkdir()
    (packages / "torch-2.10.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: torch\nVersion: 2.10.0\n"
    )
    expected = "globalsplat was compiled for PyTorch 2.11, and 2.10.0 is installed: pip install 'torch==2.11.*'"
    environment = {**os.environ, "PYTHONPATH": str(packages)}
    assert_refused(expected, environment)


def test_another_platform_is_refused_before_anything_is_loaded(tmp_path):
    installed = Path(globalsplat.__file__).parent
    (tmp_path / "globalsplat").symlink_to(installed)
    system = "macosx" if sys.platform == "darwin" else sys.platform
    for tag in ("manylinux_2_28_riscv64", f"win_{platform.machine()}"):
        metadata = tmp_path / f"globalsplat-{globalsplat.__version__}.dist-info"
        metadata.mkdir(exist_ok=True)
        (metadata / "METADATA").write_text(f"Name: globalsplat\nVersion: {globalsplat.__version__}\n")
        (metadata / "WHEEL").write_text(f"Wheel-Version: 1.0\nTag: cp310-abi3-{tag}\n")
        expected = f"globalsplat was compiled for {tag}, and this is {system} on {platform.machine()}: install the wheel for it"
        assert_refused(expected, {**os.environ, "PYTHONPATH": str(tmp_path)})


def assert_refused(expected, environment):
    """Asserts that the package and its program end with this sentence."""
    imported = run(sys.executable, "-c", "from globalsplat import rasterization", env=environment)
    assert imported.returncode == 1 and imported.stderr.splitlines()[-1] == f"ImportError: {expected}"
    program = run(sys.executable, "-m", "globalsplat", "doctor", env=environment)
    assert program.returncode == 1 and program.stderr == f"globalsplat: {expected}\n"


def test_the_version_of_torch_is_the_required_one():
    requires = importlib.metadata.requires("globalsplat")
    assert requires is not None and f"torch=={_requirements.REQUIRED}.*" in requires
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    assert project["version"] == globalsplat.__version__ == importlib.metadata.version("globalsplat")


def test_photos_without_poses_are_refined_with_the_extra_for_poses(capture, tmp_path):
    requires = importlib.metadata.requires("globalsplat")
    assert requires is not None and any("pycolmap" in each and 'extra == "poses"' in each for each in requires)
    if importlib.util.find_spec("pycolmap") is None:
        assert not os.environ.get("GLOBALSPLAT_NO_SKIPS"), "pycolmap isn't installed (make poses)"
        pytest.skip("pycolmap isn't installed (make poses)")
    photos = tmp_path / "photos"
    photos.mkdir()
    for index, name in enumerate(capture.names):
        Image.fromarray(capture.image(index)).save(photos / f"{Path(name).stem}.png")
    # The Python of the environment has pycolmap, also while no environment is active.
    environment = {"PATH": "/usr/bin:/bin", "TMPDIR": str(tmp_path)}
    program = f"{sys.prefix}/bin/globalsplat"
    out = tmp_path / "room.ply"
    refined = run(program, "refine", "--photos", str(photos), "--seconds", "5", "--out", str(out), env=environment)
    assert refined.returncode == 0, refined.stderr
    assert len(globalsplat.load_splat(out)["means"]) > 1000


def test_the_package_imports_torch_only_when_needed():
    code = "import sys, globalsplat; assert 'torch' not in sys.modules; globalsplat.rasterization; assert 'torch' in sys.modules"
    assert run(sys.executable, "-c", code).returncode == 0
    assert set(globalsplat.__all__) <= set(dir(globalsplat))
    for name in globalsplat.__all__:
        assert getattr(globalsplat, name).__doc__, name


def test_a_reconstruction_looks_like_the_photos(splat, capture):
    assert len(capture) == 9 and repr(capture) == 'Capture("322261824c4a3003", 9 photos)'
    assert splat["means"].shape == (16384, 3) and splat["sh_degree"] == 1
    assert psnr(*render(splat, capture)) > 21.0


def test_it_equals_the_program_s(splat, capture_folder, tmp_path):
    program = f"{sys.prefix}/bin/globalsplat"
    done = run(program, "reconstruct", "--scene", str(capture_folder), "--out", str(tmp_path / "program.ply"))
    assert done.returncode == 0, done.stderr
    globalsplat.save_splat(tmp_path / "python.ply", splat)
    ours, theirs = (globalsplat.load_splat(tmp_path / name) for name in ("python.ply", "program.ply"))
    for name in ("means", "quats", "scales", "opacities", "colors"):
        np.testing.assert_allclose(ours[name], theirs[name], rtol=2e-6, atol=1e-6)


def test_images_in_memory_are_a_capture(splat, capture):
    images = torch.stack([torch.from_numpy(capture.image(index)) for index in range(len(capture))])
    viewmats, Ks = torch.from_numpy(capture.viewmats), torch.from_numpy(capture.Ks)
    for given in (images, images.float() / 255.0):
        same = globalsplat.reconstruct(given, viewmats, Ks)
        torch.testing.assert_close(same["means"], splat["means"])
    with pytest.raises(ValueError, match="images need viewmats and Ks"):
        globalsplat.reconstruct(images)
    with pytest.raises(ValueError, match=r"expected uint8 or floats \[V, H, W, 3\]"):
        globalsplat.reconstruct(images[0], viewmats, Ks)


@pytest.mark.parametrize("extension", FORMATS)
def test_splats_are_written_and_read_in_every_format(splat, capture, tmp_path, extension):
    path = tmp_path / f"room.{extension}"
    globalsplat.save_splat(path, splat, capture=capture)
    read = globalsplat.load_splat(path)
    assert read["means"].dtype == np.float32 and len(read["means"]) == 16384
    kept = with_mean_colors(splat, capture) if extension == "splat" else splat
    assert abs(psnr(*render(read, capture)) - psnr(*render(kept, capture))) < FORMATS[extension]
    parameters = globalsplat.load_splat(path, activated=False)
    globalsplat.save_splat(tmp_path / "again.ply", parameters, activated=False)
    again = globalsplat.load_splat(tmp_path / "again.ply", activated=False)
    assert again["rasterize_mode"] == parameters.pop("rasterize_mode")
    for name, value in parameters.items():
        is_finite = np.isfinite(value)  # logits of opacities of 0 and 1 are not, and a PLY has finite ones
        np.testing.assert_array_equal(again[name][is_finite], value[is_finite])


def test_refinement_improves_a_splat(splat, capture):
    steps = []
    refined = globalsplat.refine(
        capture, splat, steps=100, views=4, size=128, progress=lambda done, _: steps.append(done)
    )
    assert steps[-1] == 100
    assert psnr(*render(refined, capture)) > psnr(*render(splat, capture)) + 1.0
    with pytest.raises(ZeroDivisionError):
        globalsplat.refine(capture, splat, steps=30, views=4, size=128, progress=lambda *_: 1 / 0)
    antialiased = globalsplat.refine(capture, steps=2, gaussians=200, views=3, size=64, settings={"antialiased": True})
    assert antialiased["rasterize_mode"] == "antialiased"
    with pytest.raises(ValueError, match="steps is 0, expected 1 or more"):
        globalsplat.refine(capture, steps=0)
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="device is cuda, and PyTorch finds 0 CUDA devices"):
            globalsplat.refine(capture, steps=1, device="cuda")
    with pytest.raises(ValueError, match="unknown field `nothing`"):
        globalsplat.refine(capture, splat, settings={"nothing": 1})


def test_the_model_in_pytorch_gives_the_program_s_gaussians(capture, tmp_path):
    model = globalsplat.load_model()
    assert sum(parameter.numel() for parameter in model.parameters()) == 2_031_523
    size = 96
    images, Ks = [], torch.from_numpy(capture.Ks[:4]).clone()
    for index in range(4):
        image = torch.from_numpy(capture.image(index)).permute(2, 0, 1)[None].float() / 255.0
        images.append(torch.nn.functional.interpolate(image, (size, size), mode="area"))
    Ks[:, :2] *= size / capture.sizes[0][0]
    c2w, _, _ = normalize_scene(torch.from_numpy(capture.viewmats[:4]).inverse())
    gaussians = model(torch.cat(images)[None], c2w[None].float(), Ks[None].float())
    assert gaussians["means"].shape == (1, 16384, 3) and gaussians["colors"].shape == (1, 16384, 4, 3)
    scene = {name: value.detach()[0] for name, value in gaussians.items()}
    image, _, _ = globalsplat.rasterization(
        **scene, viewmats=c2w[:1].inverse().float(), Ks=Ks[:1].float(), width=size, height=size, sh_degree=1, eps2d=0.05
    )
    assert psnr(image[0].clamp(0.0, 1.0), images[0][0].permute(1, 2, 0)) > 15.0
