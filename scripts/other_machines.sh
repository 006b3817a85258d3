#!/usr/bin/env bash
# Runs tests once more as on other machines than this one:
#   scripts/other_machines.sh            on both of these
#   scripts/other_machines.sh ordinary   tests on AVX2 without AVX-512 and bf16, as a user who isn't root and has no home, in a
#                                        folder with a space that only its owner may write to, in another language and time zone,
#                                        without standard input; then the demo in small
#   scripts/other_machines.sh small      tests of what computes, on one core with SSE2
#   scripts/other_machines.sh ordinary view splat    of the former, those of tests/view.rs and tests/splat.rs alone
# Fails at the end if a test did. As root it lets others pass through the folders above the repository until then.
set -euo pipefail
cd "$(dirname "$0")/.."
repository=$PWD
# `make test` proves that nothing is missing; what that user can't reach is skipped here, and said.
unset GLOBALSPLAT_NO_SKIPS

folder="$(mktemp -d)"
clone="$folder/a folder/globalsplat"
export GLOBALSPLAT_SKIPPED="$folder/skipped"
opened=()
end() {
    [ ${#opened[@]} -eq 0 ] || chmod o-x "${opened[@]}"
    rm -rf "$folder"
}
trap end EXIT

# The tests that were asked for by name, all if none was; lib and main are those beside the code.
chosen=("${@:2}")
targets=()
for name in "${chosen[@]}"; do
    case "$name" in
    lib) targets+=(--lib) ;;
    main) targets+=(--bin globalsplat) ;;
    *) targets+=(--test "$name") ;;
    esac
done
built="$("${CARGO:-cargo}" test --release --locked --no-run "${targets[@]}" 2>&1)" || {
    echo "$built" >&2
    exit 1
}
# A line for each program of tests: its name, which is lib, main or that of a file in tests/, and its path.
tests="$(sed -nE 's|^ *Executable (unittests src/)?(tests/)?([a-z_]+)\.rs \((.*)\)$|\3 \4|p' <<<"$built")"

# Slow tests, or tests of text, that none of these machines' traits decide: compilers' and other programs' answers, sums of processes,
# memory that runs out. They run here where they are asked for by name.
alike=" architecture citations cuda distributed refused_memory viewers "

failed=()
# Runs the tests $2…, or all, by the command $1; of these, the chosen ones. Says what they were skipped for want of.
run() {
    local as=$1 name program ran=false
    shift
    : >"$GLOBALSPLAT_SKIPPED"
    chmod a+rw "$GLOBALSPLAT_SKIPPED"
    while read -r name program; do
        [ $# -eq 0 ] || [[ " $* " == *" $name "* ]] || continue
        if [ ${#chosen[@]} -gt 0 ]; then
            [[ " ${chosen[*]} " == *" $name "* ]] || continue
        else
            [[ $alike != *" $name "* ]] || continue
        fi
        [ "${program:0:1}" = / ] || program="$repository/$program"
        echo "$as: $name"
        ran=true
        "$as" "$program" --quiet </dev/null || failed+=("$as: $name")
    done <<<"$tests"
    $ran || {
        echo "other_machines: $as runs no test of ${chosen[*]}" >&2
        exit 2
    }
    [ ! -s "$GLOBALSPLAT_SKIPPED" ] || echo "$as: skipped for want of $(sort -u "$GLOBALSPLAT_SKIPPED" | paste -sd , | sed 's/,/, /g')"
}

# One whose letters and numbers differ most from English, where it is installed.
language="$(locale -a 2>/dev/null | grep -im1 '^tr_TR' || echo C)"
as_ordinary() {
    local other_user=()
    [ "$(id -u)" -ne 0 ] || other_user=(setpriv --reuid=65534 --regid=65534 --clear-groups)
    (
        cd "$clone"
        umask 077
        exec env -u HOME -u TERM -u XDG_CACHE_HOME LC_ALL="$language" TZ=Pacific/Kiritimati NO_COLOR=1 TMPDIR="$folder/a folder/tmp" \
            GLOBALSPLAT_SIMD=avx2 "${other_user[@]}" "$@" <&-
    )
}

as_small() {
    local core
    core="$(taskset -cp $$ | sed -E 's/.*[ ,-]([0-9]+)$/\1/')"
    GLOBALSPLAT_SIMD=portable OMP_NUM_THREADS=1 taskset -c "$core" "$@"
}

# A copy of what git knows, with links to what was built and installed.
make_clone() {
    local made
    mkdir -p "$clone" "$folder/a folder/tmp"
    git ls-files -z | xargs -0 cp --parents -t "$clone"
    for made in target weights .venv web/dist parity/npm/node_modules; do
        [ ! -e "$made" ] || ln -s "$repository/$made" "$clone/$made"
    done
    chmod -R a+rX,go-w "$folder"
    chmod 1777 "$folder/a folder/tmp"
}

run_ordinary() {
    local above=$repository
    make_clone
    while [ "$(id -u)" -eq 0 ] && [ "$above" != / ]; do
        if (((8#$(stat -c %a "$above") & 1) == 0)); then
            chmod o+x "$above"
            opened+=("$above")
        fi
        above="$(dirname "$above")"
    done
    # Tests that need torchrun are left out where Python lies in a folder that is closed to that user, as root's home is. The first
    # program that setpriv starts reaches more than those after it.
    as_ordinary env .venv/bin/python -c '' 2>/dev/null || {
        echo "as_ordinary: without torchrun, as this user can't start .venv/bin/python"
        local -x TORCHRUN=/nonexistent
    }
    run as_ordinary
    [ ${#chosen[@]} -eq 0 ] || return 0
    echo "as_ordinary: demo"
    OUT="$folder/a folder/tmp/demo" CAPTURES=none as_ordinary scripts/demo.sh --dry-run || failed+=("as_ordinary: demo")
}

run_small() {
    run as_small lib splat model refine examples
}

case "${1:-all}" in
ordinary) run_ordinary ;;
small) run_small ;;
all)
    run_ordinary
    run_small
    ;;
*)
    echo "other_machines: $1 is no machine, expected ordinary or small" >&2
    exit 2
    ;;
esac
[ ${#failed[@]} -eq 0 ] || {
    printf 'other_machines: failed: %s\n' "${failed[@]}" >&2
    exit 1
}
