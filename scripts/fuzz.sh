#!/usr/bin/env bash
# Fuzzes every reader of files from elsewhere, or those named: scripts/fuzz.sh [SECONDS each] [READER]…
# Begins with fuzz/seeds and goes on from fuzz/corpus; a finding is left in fuzz/artifacts, and belongs into fuzz/seeds once
# it is mended, where `cargo test` reads it for good. Needs `cargo install cargo-fuzz`.
set -euo pipefail
cd "$(dirname "$0")/.."
seconds=${1:-120}
shift || true
readers=("$@")
[ ${#readers[@]} -gt 0 ] || readers=($(ls fuzz/seeds))

# The sanitizers are unstable features, but they are in the stable toolchain, too.
export RUSTC_BOOTSTRAP=1
libtorch=${LIBTORCH:-.venv/libtorch}
export LD_LIBRARY_PATH="$libtorch/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
for reader in "${readers[@]}"; do
    mkdir -p "fuzz/corpus/$reader"
    echo "$reader"
    cargo fuzz run "$reader" "fuzz/corpus/$reader" "fuzz/seeds/$reader" -- \
        -max_total_time="$seconds" -timeout=10 -rss_limit_mb=2048 -print_final_stats=1 -verbosity=0
done
