"""Tests that chunks are exchanged with PyTorch unchanged, and that the program runs no code from a malicious pickle."""

import json
import os
import subprocess
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from rooms import make_rooms

REPOSITORY = Path(__file__).resolve().parents[2]
PROGRAM = REPOSITORY / "target/release/globalsplat"


def run(*arguments):
    return subprocess.run([PROGRAM, *map(str, arguments)], capture_output=True, text=True)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    make_rooms(folder, 1, 5, 24)
    return folder / "room_000"


@pytest.fixture(scope="module")
def packed(room, tmp_path_factory):
    folder = tmp_path_factory.mktemp("chunks")
    assert run("pack", room, "--out", folder).returncode == 0
    return folder


def bytes_of(image):
    return image.numpy().tobytes()


@pytest.mark.parametrize("weights_only", [True, False])
def test_torch_load_reads_what_pack_writes(room, packed, weights_only):
    assert json.loads((packed / "index.json").read_text()) == {"room_000": "000000.torch"}
    [scene] = torch.load(packed / "000000.torch", weights_only=weights_only)
    assert {key: type(value) for key, value in scene.items()} == {
        "key": str,
        "url": str,
        "timestamps": torch.Tensor,
        "cameras": torch.Tensor,
        "images": list,
    }
    assert scene["key"] == "room_000"
    assert scene["timestamps"].tolist() == list(range(5))
    assert [bytes_of(image) for image in scene["images"]] == [
        path.read_bytes() for path in sorted((room / "images").iterdir())
    ]
    capture = json.loads((room / "cameras.json").read_text())
    assert scene["cameras"].dtype == torch.float32 and scene["cameras"].shape == (5, 18)
    for numbers, view in zip(scene["cameras"].double().numpy(), capture["views"], strict=True):
        k = np.array(view["intrinsic"]) / 24
        np.testing.assert_allclose(numbers[:6], [k[0, 0], k[1, 1], k[0, 2], k[1, 2], 0, 0], atol=1e-6)
        np.testing.assert_allclose(numbers[6:].reshape(3, 4), np.linalg.inv(view["c2w"])[:3], atol=1e-6)


def test_what_python_saves_is_read_the_same(packed, tmp_path):
    [scene] = torch.load(packed / "000000.torch")
    # Layouts that occur in datasets: slices of larger tensors, shared tensors, more scenes than one batch of the
    # pickler.
    video = torch.cat(scene["images"])
    offsets = np.cumsum([0, *(len(image) for image in scene["images"])])
    sliced = dict(scene, key="sliced", images=[video[a:b] for a, b in pairwise(offsets)])
    shared = dict(scene, key="shared", url="https://example.org/é")
    many = [dict(scene, key=f"scene_{i}") for i in range(1100)]
    torch.save([scene, sliced, shared, *many], tmp_path / "python.torch")

    seen = json.loads(run("inspect", tmp_path / "python.torch", "--json").stdout)
    assert seen["scenes"] == 1103 and set(seen["views"].values()) == {5}
    for key in ["sliced", "shared", "scene_1099"]:
        again = tmp_path / key
        done = run("pack", f"{tmp_path / 'python.torch'}#{key}", "--out", again)
        assert done.returncode == 0, done.stderr
        [copy] = torch.load(again / "000000.torch")
        assert [bytes_of(image) for image in copy["images"]] == [bytes_of(image) for image in scene["images"]]
        torch.testing.assert_close(copy["cameras"], scene["cameras"], atol=1e-6, rtol=0)


class RunsSomething:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_a_chunk_that_runs_something_is_refused_and_runs_nothing(packed, tmp_path):
    made, file = tmp_path / "made", tmp_path / "evil.torch"
    torch.save([*torch.load(packed / "000000.torch"), RunsSomething(made)], file)
    done = run("inspect", file)
    assert done.returncode == 2 and "data.pkl is a pickle that calls posix.mkdir" in done.stderr
    assert not made.exists()
    torch.load(file, weights_only=False)  # confirms that the pickle does create the folder
    assert made.exists()
