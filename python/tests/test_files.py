"""Splat files and captures without the network, and in forked processes."""

import json
import multiprocessing

import globalsplat
import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils.data import DataLoader, Dataset

COUNT, VIEWS, WIDTH, HEIGHT = 40, 4, 48, 32
#: An origin in UTM coordinates, where float32 positions are half a unit apart.
ORIGIN = np.array([448_265.12, 5_411_920.65, 135.4])


@pytest.fixture(scope="module")
def splat():
    generator = np.random.default_rng(1)

    def normal(*shape):
        return generator.normal(size=(COUNT, *shape)).astype(np.float32)

    numbers = {"means": normal(3) + np.float32([0, 0, 4]), "quats": normal(4), "colors": 0.5 * normal(4, 3)}
    scales, opacities = np.full((COUNT, 3), 0.2, np.float32), np.linspace(0.1, 0.9, COUNT, dtype=np.float32)
    return {**numbers, "scales": scales, "opacities": opacities, "sh_degree": 1}


def viewmats(origin=(0.0, 0.0, 0.0)):
    """Returns cameras in a row, which look along z from near `origin`."""
    matrices = np.tile(np.eye(4), (VIEWS, 1, 1))
    matrices[:, 0, 3] = np.linspace(-1.0, 1.0, VIEWS)
    matrices[:, :3, 3] -= origin
    return matrices


KS = np.tile([[40.0, 0.0, WIDTH / 2], [0.0, 40.0, HEIGHT / 2], [0.0, 0.0, 1.0]], (VIEWS, 1, 1))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture of nerfstudio's format around ORIGIN, whose photos show noise."""
    folder = tmp_path_factory.mktemp("capture")
    noise = np.random.default_rng(2).integers(0, 255, (VIEWS, HEIGHT, WIDTH, 3), np.uint8)
    frames = []
    for index, (viewmat, pixels) in enumerate(zip(viewmats(ORIGIN), noise, strict=True)):
        Image.fromarray(pixels).save(folder / f"{index}.png")
        c2w = np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"{index}.png", "transform_matrix": c2w.tolist()})
    lens = {"fl_x": 40, "fl_y": 40, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def render(splat, matrices):
    tensors = {name: torch.as_tensor(value) if hasattr(value, "shape") else value for name, value in splat.items()}
    cameras = {"viewmats": torch.from_numpy(matrices), "Ks": torch.from_numpy(KS), "width": WIDTH, "height": HEIGHT}
    return globalsplat.rasterization(**tensors, **cameras)[0]


@pytest.mark.parametrize("activated", [True, False])
def test_an_origin_is_kept_and_rendered(splat, tmp_path, activated):
    file, copy = tmp_path / "splat.ply", tmp_path / "copy.spz"
    globalsplat.save_splat(file, {**splat, "origin": ORIGIN})
    read = globalsplat.load_splat(file, activated=activated)
    assert read["origin"].dtype == np.float64 and (read["origin"] == ORIGIN).all()
    assert (read["means"] == splat["means"]).all()
    globalsplat.save_splat(copy, read, activated=activated)
    again = globalsplat.load_splat(copy)
    assert (again["origin"] == ORIGIN).all()
    assert (render(splat, viewmats()) - render(again, viewmats(ORIGIN))).abs().max() < 0.05
    globalsplat.save_splat(copy, {**splat, "origin": torch.zeros(3)})
    assert "origin" not in globalsplat.load_splat(copy) and not (tmp_path / "copy.spz.origin.json").exists()


def test_refinement_far_away_starts_and_ends_at_an_origin(splat, folder):
    capture = globalsplat.load_capture(folder)
    refined = globalsplat.refine(capture, {**splat, "origin": ORIGIN}, steps=1)
    before, after = (render(one, capture.viewmats) for one in ({**splat, "origin": ORIGIN, "eps2d": 0.05}, refined))
    assert np.abs(refined["origin"].numpy() - ORIGIN).max() < 10.0
    assert (before - after).abs().mean() < 0.05


def test_harmonics_above_the_degree_are_not_saved(splat, tmp_path):
    globalsplat.save_splat(tmp_path / "splat.ply", {**splat, "sh_degree": 0})
    read = globalsplat.load_splat(tmp_path / "splat.ply")
    assert read["sh_degree"] == 0 and (read["colors"] == splat["colors"][:, :1]).all()


def test_splats_that_do_not_fit_are_refused(splat, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.ply can't be read"):
        globalsplat.load_splat(tmp_path / "nothing.ply")
    with pytest.raises(ValueError, match=r"the ending is \.foo"):
        globalsplat.save_splat(tmp_path / "room.foo", splat)
    with pytest.raises(ValueError, match="the splat has no quats"):
        globalsplat.save_splat(tmp_path / "room.ply", {"means": splat["means"]})
    for name, value, expected in (
        ("means", splat["means"] * float("nan"), "means has values that aren't finite"),
        ("means", splat["means"].astype(np.float64) * 1e39, "means has values that aren't finite in float32"),
        ("colors", torch.zeros(COUNT, 5, 3), "5 spherical harmonics"),
        ("scales", splat["scales"][:5], r"scales has shape \[5, 3\], expected \[40, 3\]"),
        ("quats", splat["quats"].T, r"quats has shape \[4, 40\], expected \[40, 4\]"),
        ("scales", -splat["scales"], r"scales has -.*, expected 0 to 1\.65"),
        ("scales", splat["scales"] * float("inf"), r"scales has inf, expected 0 to 1\.65"),
        ("opacities", splat["opacities"] + 1.0, r"opacities has .*, expected 0 to 1"),
        ("rasterize_mode", "smooth", r"rasterize_mode is 'smooth', expected classic or antialiased"),
        ("sh_degree", 2, "colors has 4 spherical harmonics, expected 9 or more for degree 2"),
        ("origin", ORIGIN[:2], r"origin has shape \[2\], expected \[3\]"),
    ):
        with pytest.raises(ValueError, match=expected):
            globalsplat.save_splat(tmp_path / "room.ply", {**splat, "sh_degree": None, name: value})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [255.0, float("nan")])
def test_images_out_of_range_are_refused(number):
    images = torch.full((VIEWS, HEIGHT, WIDTH, 3), number)
    with pytest.raises(ValueError, match=rf"images have {number:g}, expected floats from 0 to 1, or uint8"):
        globalsplat.reconstruct(images, torch.from_numpy(viewmats()), torch.from_numpy(KS))


class Work(Dataset):
    """Returns the sums of what the package's functions compute."""

    def __init__(self, splat, folder):
        self.splat, self.folder = splat, folder

    def __len__(self):
        return VIEWS

    def __getitem__(self, index):
        capture = globalsplat.load_capture(self.folder)
        path = self.folder / f"{index}.sog"
        globalsplat.save_splat(path, self.splat, capture=capture)
        means = torch.tensor(globalsplat.load_splat(path)["means"], requires_grad=True)
        render({**self.splat, "means": means}, viewmats()).sum().backward()
        return int(capture.image(index).sum()), means.grad.sum()


def test_everything_works_in_forked_workers(splat, folder):
    work = Work(splat, folder)
    expected = [work[index] for index in range(VIEWS)]  # starts the threads that a fork loses
    fork = multiprocessing.get_context("fork")
    loader = DataLoader(work, num_workers=2, timeout=30, batch_size=None, multiprocessing_context=fork)
    assert [tuple(each) for each in loader] == expected
