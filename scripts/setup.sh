#!/usr/bin/env bash
# Finds a Rust toolchain, a C++ compiler, Python and libtorch, and reports in one line which is missing. Downloads the LPIPS weights if
# possible; without them, evaluation omits LPIPS.
#   setup.sh           prepares the build: installs libtorch in .venv, unless LIBTORCH names one already
#   setup.sh venv      always creates .venv, in which the parity checks run, and installs Node.js packages if Node.js is installed
#   setup.sh poses     installs pycolmap in .venv, which finds the poses of photos
#   setup.sh weights   downloads the LPIPS weights, or fails
set -euo pipefail
cd "$(dirname "$0")/.."

missing() {
    echo "setup: $1" >&2
    exit 2
}

# Downloads the LPIPS weights, or fails.
weights() {
    local python=.venv/bin/python
    [ -x "$python" ] || python="${PYTHON:-python3}"
    command -v "$python" >/dev/null || missing "no Python found, which is needed to download the LPIPS weights"
    "$python" scripts/lpips_weights.py
}

weights_if_possible() {
    (weights) || echo "setup: LPIPS is left out (make weights tries again)" >&2
}

# Makes .venv, unless it is there, and checks the version of the Python that it needs.
make_venv() {
    local python="${PYTHON:-python3}"
    if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
        missing "no Python 3.11 or newer found; install one or name it with PYTHON=... (it brings libtorch and runs the parity checks)"
    fi
    [ -x .venv/bin/python ] || "$python" -m venv .venv \
        || missing "$python can't make a virtual environment; install its venv module (Debian: apt install python3-venv)"
}

npm_ci=(npm ci --ignore-scripts --no-audit --no-fund --loglevel=error --no-update-notifier)

# Bundles the viewer that `globalsplat view` embeds in its pages, from the packages that web/ pins. Without npm or a registry, the
# program is built without it, and reports this when the user requests a page.
page() {
    [ -z "$(find web/src web/package-lock.json -newer web/dist/page.js 2>&1 | head -n 1)" ] && return
    if ! command -v npm >/dev/null; then
        echo "setup: no npm found: the program is built without the interactive viewer; install Node.js 20 or newer to include it" >&2
        return
    fi
    echo "setup: bundling the viewer that web/ pins" >&2
    if ! { "${npm_ci[@]}" --prefix web >/dev/null && npm run --prefix web --silent build; }; then
        echo "setup: npm failed; the program is built without the interactive viewer" >&2
    fi
}

if [ "${1:-}" = weights ]; then
    weights
    exit
fi
if [ "${1:-}" = poses ]; then
    make_venv
    .venv/bin/python -m pip install --quiet --disable-pip-version-check -r requirements-poses.txt \
        || missing "requirements-poses.txt can't be installed; see pip's message above"
    exit
fi

command -v "${CARGO:-cargo}" >/dev/null || missing "no Rust found; install it with rustup, version 1.89 or newer"
command -v "${CXX:-c++}" >/dev/null || missing "no C++ compiler found; install g++ or clang (Debian: apt install g++; macOS: xcode-select --install)"

page
if [ -n "${LIBTORCH:-}" ]; then
    [ -e "$LIBTORCH/include/torch" ] || missing "LIBTORCH is $LIBTORCH, which has no include/torch; set it to a libtorch 2.11 folder, or unset it"
    if [ "${1:-}" != venv ]; then
        weights_if_possible
        exit
    fi
fi

make_venv
if ! cmp -s requirements.txt .venv/requirements.txt; then
    echo "setup: installing what requirements.txt pins into .venv (libtorch is most of it)" >&2
    if [ ! -e .venv/libtorch ]; then
        # Meanwhile, cargo compiles the crates that don't need libtorch, at low priority. The others fail, and are built later.
        nice "${CARGO:-cargo}" build --release --locked --workspace --keep-going >/dev/null 2>&1 &
        early=$!
        trap 'kill "$early" 2>/dev/null || true' EXIT
    fi
    # --no-compile: Python compiles modules when they are first imported.
    .venv/bin/python -m pip install --disable-pip-version-check --no-compile -r requirements.txt \
        || missing "requirements.txt can't be installed; see pip's message above"
    cp requirements.txt .venv/requirements.txt
fi
# Cargo looks for libtorch at this path (.cargo/config.toml), which does not depend on the Python version.
ln -sfn "$(.venv/bin/python -c 'import importlib.util, os; print(os.path.dirname(importlib.util.find_spec("torch").origin))')" .venv/libtorch

# Third-party readers of splats, which tests compare ours with. Without Node.js or a registry, these tests are skipped.
if [ "$(node -p 'process.versions.node.split(".")[0] >= 20' 2>/dev/null)" = true ] && command -v npm >/dev/null \
    && ! cmp -s parity/npm/package-lock.json parity/npm/node_modules/.installed; then
    echo "setup: installing what parity/npm pins" >&2
    if "${npm_ci[@]}" --prefix parity/npm >/dev/null; then
        cp parity/npm/package-lock.json parity/npm/node_modules/.installed
    else
        rm -rf parity/npm/node_modules
        echo "setup: npm failed; tests that need these packages are skipped" >&2
    fi
fi

weights_if_possible
if [ -n "${early:-}" ]; then
    echo "setup: compiling the crates that don't need libtorch" >&2
    wait "$early" || true
    trap - EXIT
fi
