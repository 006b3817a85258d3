#!/usr/bin/env bash
# Installs the wheel of target/wheels in a fresh virtual environment, in which nothing of the repository is on any path, and tests it there.
# The environment has links to the packages of .venv, so PyTorch isn't downloaded again.
#   scripts/check_wheel.sh [ARGUMENT OF PYTEST…]
set -euo pipefail
cd "$(dirname "$0")/.."
target="$(realpath "${CARGO_TARGET_DIR:-target}")"
environment="$target/wheel-venv"

rm -rf "$environment"
.venv/bin/python -m venv --without-pip "$environment"
packages="$("$environment/bin/python" -c 'import site; print(site.getsitepackages()[0])')"
for package in "$(.venv/bin/python -c 'import site; print(site.getsitepackages()[0])')"/*; do
    case "$(basename "$package")" in
    *editable* | globalsplat* | parity* | *.pth) ;; # of the repository, or they may lead there
    *) ln -s "$package" "$packages/" ;;
    esac
done
.venv/bin/python -m pip --python "$environment/bin/python" install --quiet --disable-pip-version-check --no-deps --no-index "$target"/wheels/*.whl
GLOBALSPLAT_CAPTURES="${GLOBALSPLAT_CAPTURES:-$(realpath -m ../shared/data)}"
export GLOBALSPLAT_CAPTURES
export -n PYTHONPATH LD_LIBRARY_PATH
"$environment/bin/python" -P -m pytest -q -p no:cacheprovider python/tests "$@"
