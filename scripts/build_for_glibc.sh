#!/usr/bin/env bash
# Builds the program, or a package of the workspace, and links it for the older libraries of scripts/link_for_glibc.sh.
#   scripts/build_for_glibc.sh                       target/release/globalsplat
#   scripts/build_for_glibc.sh globalsplat-python    target/release/lib_native.so
# Links by a `cc` that comes first in the PATH. With a linker in its configuration, cargo would build everything again, and `cargo rustc`
# would build many crates again with fewer features.
set -euo pipefail
cd "$(dirname "$0")/.."
target="${CARGO_TARGET_DIR:-target}"
build=("${CARGO:-cargo}" build --release --locked) linked=globalsplat
if [ -n "${1:-}" ]; then
    build+=(-p "$1")
    linked=lib_native.so
fi

scripts/heartbeat.sh building "${build[@]}"
mkdir -p "$target/linker"
printf '#!/bin/sh\nCC="%s" exec "%s" "$@"\n' "$(command -v cc)" "$PWD/scripts/link_for_glibc.sh" >"$target/linker/cc"
chmod +x "$target/linker/cc"
find "$target/release/deps" -samefile "$target/release/$linked" -delete
PATH="$(realpath "$target")/linker:$PATH" scripts/heartbeat.sh linking "${build[@]}"
scripts/link_for_glibc.sh --check "$target/release/$linked"
