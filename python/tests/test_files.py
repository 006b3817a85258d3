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
