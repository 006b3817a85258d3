#!/usr/bin/env bash
# Fuzzes every reader of untrusted files, or the named ones, under AddressSanitizer and, if clang++ is installed,
# UndefinedBehaviorSanitizer for the C++:
#   scripts/fuzz.sh [SECONDS each] [READER]…
# Starts from fuzz/seeds.zip and the corpora of earlier runs in fuzz/corpus. A failing input is saved in fuzz/artifacts. Once the bug is
# fixed, add the input to fuzz/seeds.zip in the folder of its reader (`zip fuzz/seeds.zip READER/NAME`), where `cargo test` reads it from
# then on. fuzz/runs.log records the number of inputs per reader.
# Needs `cargo install cargo-fuzz`.
set -euo pipefail
cd "$(dirname "$0")/.."
seconds=${1:-120}
shift || true
readers=("$@")
[ ${#readers[@]} -gt 0 ] || readers=($(unzip -Z1 fuzz/seeds.zip | cut -d/ -f1 | sort -u))

# The sanitizers are unstable features, but the stable toolchain contains them.
export RUSTC_BOOTSTRAP=1
export LIBTORCH=${LIBTORCH:-$PWD/.venv/libtorch}
export LD_LIBRARY_PATH="$LIBTORCH/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
# GCC reports a constant array of zstd as used out of scope.
export CFLAGS="-fno-sanitize-address-use-after-scope${CFLAGS:+ $CFLAGS}"
# Each reader runs on one thread. Leak detection is off because libtorch keeps allocations until the process ends.
export OMP_NUM_THREADS=1 ASAN_OPTIONS="detect_leaks=0:allocator_may_return_null=1${ASAN_OPTIONS:+:$ASAN_OPTIONS}"
if command -v clang++ >/dev/null; then
    # For an empty tensor, tch copies 0 bytes from a null pointer, which nonnull-attribute would report.
    export CXX=clang++
    export CXXFLAGS="-fsanitize=address,undefined -fno-sanitize=vptr,function,nonnull-attribute -fno-sanitize-recover=undefined \
-fsanitize-coverage=inline-8bit-counters,pc-table,trace-cmp -fsanitize-coverage-ignorelist=$PWD/fuzz/uninstrumented.txt \
-fsanitize-ignorelist=$PWD/fuzz/uninstrumented.txt -fno-omit-frame-pointer -gline-tables-only"
fi

# The program's own lock file, so that every dependency has the version that the program is tested with.
cp Cargo.lock fuzz/Cargo.lock
cargo fuzz build reader
mkdir -p fuzz/corpus
unzip -nq fuzz/seeds.zip -d fuzz/corpus
target=fuzz/target/$(rustc -vV | sed -n 's/host: //p')/release/reader

for reader in "${readers[@]}"; do
    mkdir -p "fuzz/corpus/$reader" "fuzz/artifacts/$reader"
    log=$(mktemp)
    FUZZ_READER=$reader "$target" "fuzz/corpus/$reader" "-artifact_prefix=fuzz/artifacts/$reader/" \
        -max_total_time="$seconds" -timeout=10 -rss_limit_mb=2048 -print_final_stats=1 -print_funcs=0 >"$log" 2>&1 \
        || { tail -60 "$log"; echo "$reader: found a failing input, see fuzz/artifacts/$reader" >&2; exit 1; }
    echo "$reader $(sed -n 's/stat::number_of_executed_units: *//p' "$log")" | tee -a fuzz/runs.log
    rm -f "$log"
done
