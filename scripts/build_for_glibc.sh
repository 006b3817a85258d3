#!/usr/bin/env bash
# Builds target/release/globalsplat, linked for the older libraries of scripts/link_for_glibc.sh.
# Links by a `cc` that comes first in the PATH, target/linker/cc. With a linker in its configuration, cargo would build everything again,
# and `cargo rustc` would build many crates again with fewer features.
set -euo pipefail
cd "$(dirname "$0")/.."
target="${CARGO_TARGET_DIR:-target}"
build=("${CARGO:-cargo}" build --release --locked --workspace)

"${build[@]}"
mkdir -p "$target/linker"
printf '#!/bin/sh\nCC="%s" exec "%s" "$@"\n' "$(command -v cc)" "$PWD/scripts/link_for_glibc.sh" >"$target/linker/cc"
chmod +x "$target/linker/cc"
scripts/link_for_glibc.sh --check "$target/release/globalsplat" 2>/dev/null && exit # already linked so
find "$target/release/deps" -samefile "$target/release/globalsplat" -delete
PATH="$(realpath "$target")/linker:$PATH" "${build[@]}"
scripts/link_for_glibc.sh --check "$target/release/globalsplat"
