#!/usr/bin/env bash
# Builds the wheel of the Python package in python/, for every Linux with glibc 2.28, into target/wheels.
set -euo pipefail
cd "$(dirname "$0")/.."
target="${CARGO_TARGET_DIR:-target}"

.venv/bin/python -m pip install --quiet --disable-pip-version-check -r requirements-dist.txt
# The build of the wheel takes the program from here, and links the native module by the same `cc`.
scripts/build_for_glibc.sh
rm -f "$target"/release/lib_native.so "$target"/release/deps/lib_native.so
built="$(mktemp -d)"
trap 'rm -rf "$built"' EXIT
PATH="$(realpath "$target")/linker:$PATH" .venv/bin/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir "$built" ./python
# Refuses a tag that the symbols of the files contradict. libtorch comes from the wheel of PyTorch.
rm -rf "$target/wheels"
if ! said="$(PATH="$PWD/.venv/bin:$PATH" .venv/bin/python -m auditwheel repair --plat "manylinux_2_28_$(uname -m)" \
    --exclude 'libtorch*.so' --exclude libc10.so --wheel-dir "$target/wheels" "$built"/*.whl 2>&1)"; then
    echo "wheel: $(tail -n 1 <<<"$said")" >&2
    exit 1
fi
du -h --apparent-size "$target"/wheels/*.whl
