#!/usr/bin/env bash
# Fuzzes every reader of files from elsewhere, or those named, under AddressSanitizer and, where there is a clang++,
# UndefinedBehaviorSanitizer for the C++:
#   scripts/fuzz.sh [SECONDS each] [READER]…
#   scripts/fuzz.sh coverage [READER]…         which share of each file's edges the corpora reach, in Markdown
# Begins with fuzz/seeds and goes on from fuzz/corpus; a finding is left in fuzz/artifacts, and belongs into fuzz/seeds once
# it is mended, where `cargo test` reads it for good. fuzz/runs.log adds up the inputs. Needs `cargo install cargo-fuzz`.
set -euo pipefail
cd "$(dirname "$0")/.."
what=${1:-120}
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

cargo fuzz build
binaries=fuzz/target/$(rustc -vV | sed -n 's/host: //p')/release

if [ "$what" = coverage ]; then
    symbolizer=$(command -v llvm-symbolizer || ls /usr/bin/llvm-symbolizer-* 2>/dev/null | head -1)
    for reader in "${readers[@]}"; do
        mkdir -p "fuzz/corpus/$reader"
        ASAN_OPTIONS="$ASAN_OPTIONS:external_symbolizer_path=$symbolizer" \
            "$binaries/$reader" -runs=0 -print_full_coverage=1 "fuzz/corpus/$reader" "fuzz/seeds/$reader" 2>&1
    done | python3 scripts/fuzz_coverage.py
    exit
fi
for reader in "${readers[@]}"; do
    mkdir -p "fuzz/corpus/$reader" "fuzz/artifacts/$reader"
    options=()
    [ ! -e "fuzz/dictionaries/$reader" ] || options=("-dict=fuzz/dictionaries/$reader")
    log=$(mktemp)
    "$binaries/$reader" "fuzz/corpus/$reader" "fuzz/seeds/$reader" "-artifact_prefix=fuzz/artifacts/$reader/" "${options[@]}" \
        -max_total_time="$what" -timeout=10 -rss_limit_mb=2048 -print_final_stats=1 -verbosity=0 >"$log" 2>&1 \
        || { tail -60 "$log"; echo "$reader: a finding, see fuzz/artifacts/$reader" >&2; exit 1; }
    echo "$reader $(sed -n 's/stat::number_of_executed_units: *//p' "$log")" | tee -a fuzz/runs.log
    rm -f "$log"
done
