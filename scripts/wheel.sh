#!/usr/bin/env bash
# Builds the wheel of the Python package in python/ into target/wheels, for every Linux with glibc 2.28. The branch for
# macOS 11 is untested.
set -euo pipefail
cd "$(dirname "$0")/.."
target="${CARGO_TARGET_DIR:-target}"

.venv/bin/python -m pip install --quiet --disable-pip-version-check -r requirements-dist.txt
rm -rf "$target/wheels"
# build_wheel FOLDER
build_wheel() { .venv/bin/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir "$1" ./python; }
# quietly COMMAND…: prints what the command said only if it fails.
quietly() {
    local output
    output="$("$@" 2>&1)" || { echo "wheel: $(tail -n 1 <<<"$output")" >&2; exit 1; }
}
if [ "$(uname)" = Darwin ]; then
    # Apart from the program of `make build`, which looks for libtorch elsewhere.
    CARGO_TARGET_DIR="$(realpath "$target")/wheel-macos" MACOSX_DEPLOYMENT_TARGET=11.0 build_wheel "$target/wheels"
else
    # The build of the wheel takes the program from here, and links the native module by the same `cc`.
    scripts/build_for_glibc.sh
    rm -f "$target"/release/lib_native.so "$target"/release/deps/lib_native.so
    built="$(mktemp -d)"
    trap 'rm -rf "$built"' EXIT
    PATH="$(realpath "$target")/linker:$PATH" build_wheel "$built"
    # Refuses a tag that the symbols of the files contradict. libtorch comes from the wheel of PyTorch.
    PATH="$PWD/.venv/bin:$PATH" quietly .venv/bin/python -m auditwheel repair --plat "manylinux_2_28_$(uname -m)" \
        --exclude 'libtorch*.so' --exclude libc10.so --wheel-dir "$target/wheels" "$built"/*.whl
fi
# The README and the classifiers, as package indexes take them.
quietly .venv/bin/python -m twine check --strict "$target"/wheels/*.whl
du -h "$target"/wheels/*.whl
