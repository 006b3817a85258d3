#!/usr/bin/env bash
# Fuzzes every reader of files from elsewhere, or those named, under AddressSanitizer and, where there is a clang++,
# UndefinedBehaviorSanitizer for the C++:
#   scripts/fuzz.sh [SECONDS each] [READER]…
# Begins with fuzz/seeds and goes on from fuzz/corpus; a finding is left in fuzz/artifacts, and belongs into fuzz/seeds once
# it is mended, where `cargo test` reads it for good. fuzz/runs.log has the inputs of each. Needs `cargo install cargo-fuzz`;
# scripts/fuzz_coverage.sh tells what the corpora reach.
set -euo pipefail
cd "$(dirname "$0")/.."
seconds=${1:-120}
shift || true
readers=("$@")
[ ${#readers[@]} -gt 0 ] || readers=($(ls fuzz/seeds))

# The sanitizers are unstable features, but they are in the stable toolchain, too.
export RUSTC_BOOTSTRAP=1
export LIBTORCH=${LIBTORCH:-$PWD/.venv/libtorch}
export LD_LIBRARY_PATH="$LIBTORCH/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
# One reader, one thread. What libtorch keeps until the end is no leak.
export OMP_NUM_THREADS=1 ASAN_OPTIONS="detect_leaks=0:allocator_may_return_null=1${ASAN_OPTIONS:+:$ASAN_OPTIONS}"
if command -v clang++ >/dev/null; then
    # Of no bytes, tch copies none from nowhere: nonnull-attribute would tell of each empty tensor.
    export CXX=clang++
    export CXXFLAGS="-fsanitize=address,undefined -fno-sanitize=vptr,function,nonnull-attribute -fno-sanitize-recover=undefined \
-fsanitize-coverage=inline-8bit-counters,pc-table,trace-cmp -fsanitize-coverage-ignorelist=$PWD/fuzz/uninstrumented.txt \
-fsanitize-ignorelist=$PWD/fuzz/uninstrumented.txt -fno-omit-frame-pointer -gline-tables-only"
fi

binaries=fuzz/target/$(rustc -vV | sed -n 's/host: //p')/release

for reader in "${readers[@]}"; do
    cargo fuzz build "$reader"
    mkdir -p "fuzz/corpus/$reader" "fuzz/artifacts/$reader"
    log=$(mktemp)
    "$binaries/$reader" "fuzz/corpus/$reader" "fuzz/seeds/$reader" "-artifact_prefix=fuzz/artifacts/$reader/" \
        -max_total_time="$seconds" -timeout=10 -rss_limit_mb=2048 -print_final_stats=1 -print_funcs=0 >"$log" 2>&1 \
        || { tail -60 "$log"; echo "$reader: a finding, see fuzz/artifacts/$reader" >&2; exit 1; }
    echo "$reader $(sed -n 's/stat::number_of_executed_units: *//p' "$log")" | tee -a fuzz/runs.log
    rm -f "$log"
done
