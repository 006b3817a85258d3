#!/usr/bin/env bash
# Prints a Markdown table of the line coverage that the fuzzing seeds and corpora reach in the readers of untrusted files:
#   scripts/fuzz_coverage.sh [CORPORA]        by default fuzz/corpus
# Needs `rustup component add llvm-tools` and gcov. Builds in target/coverage.
set -euo pipefail
cd "$(dirname "$0")/.."
export FUZZ_CORPORA=${1:-$PWD/fuzz/corpus}
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-target/coverage}
mkdir -p "$CARGO_TARGET_DIR"
out=$(cd "$CARGO_TARGET_DIR" && pwd)

# In Rust, only our own crates are instrumented; the C++ compiler instruments all C++.
printf '#!/bin/sh\nexec "$@" -C instrument-coverage -C link-arg=--coverage\n' >"$out/rustc"
chmod +x "$out/rustc"
export RUSTC_WORKSPACE_WRAPPER="$out/rustc" CXXFLAGS="--coverage" LLVM_PROFILE_FILE="$out/profile/%m.profraw"
rm -rf "$out/profile"
find "$out" -name '*.gcda' -delete
test=$(cargo test --release --locked --test library --no-run --message-format json |
    sed -n 's/.*"executable":"\([^"]*library-[^"]*\)".*/\1/p' | tail -1)
"$test" fuzz_seeds:: >/dev/null

tools=$(rustc --print sysroot)/lib/rustlib/$(rustc -vV | sed -n 's/host: //p')/bin
"$tools/llvm-profdata" merge -sparse "$out"/profile/*.profraw -o "$out/profile/all"
echo "| file | lines | reached |"
echo "|---|---|---|"
"$tools/llvm-cov" export --summary-only --instr-profile "$out/profile/all" "$test" | python3 -c '
import json, os, sys
unreached = []
for file in json.load(sys.stdin)["data"][0]["files"]:
    name = os.path.relpath(file["filename"])
    if name.startswith(("crates/capture/", "crates/splat-file/", "crates/torch-file/", "src/data/", "src/io/", "src/eval/index", "src/eval/scores_file", "src/config/", "src/reconstruct/model_file")):
        lines = file["summary"]["lines"]
        if lines["covered"]:
            print("| %s | %d | %.0f %% |" % (name, lines["count"], lines["percent"]))
        else:
            unreached.append(name)
print("Not reached: " + ", ".join(unreached) + ".", file=sys.stderr)
'
notes=$(find "$out" -name '*torch.gcda' -path '*globalsplat-csrc*' | head -1)
gcov --no-output "$notes" | sed -n "/^File 'chunk.cpp'/{n;s/Lines executed:\([0-9]*\)\.[0-9]*% of \([0-9]*\)/| csrc\/chunk.cpp | \2 | \1 % |/p}"
