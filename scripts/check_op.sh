#!/usr/bin/env bash
# Tests the op and the files of the Python package with the native module that `make build` has compiled, without a wheel:
#   scripts/check_op.sh [ARGUMENT OF PYTEST…]
# The package is a folder of links in target/python. scripts/check_wheel.sh tests the package as it is installed.
set -euo pipefail
cd "$(dirname "$0")/.."
target="$(realpath "${CARGO_TARGET_DIR:-target}")"
package="$target/python/globalsplat"
rm -rf "$package"
mkdir -p "$package"
ln -s "$PWD"/python/globalsplat/* "$PWD/parity/reference" "$package/"
ln -s "$target/release/lib_native.so" "$package/_native.abi3.so"
PYTHONPATH="$target/python" GLOBALSPLAT_PACKAGE="$target/python" .venv/bin/python -P -m pytest -q -p no:cacheprovider \
    python/tests/test_rasterization.py python/tests/test_files.py "$@"
