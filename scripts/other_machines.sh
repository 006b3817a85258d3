#!/usr/bin/env bash
# Runs tests again under the conditions of other machines:
#   scripts/other_machines.sh            runs both `ordinary` and `small`
#   scripts/other_machines.sh ordinary   tests on AVX2 without AVX-512 and bf16, as a user who isn't root and has no home, in a
#                                        folder with a space that only its owner may write to, in another language and time zone,
#                                        without standard input; then the demo at a reduced size
#   scripts/other_machines.sh small      tests of numerical code, on one core with SSE2
#   scripts/other_machines.sh ordinary view:: splat::    only these modules of the `ordinary` tests, without the demo
# Fails at the end if a test failed. If run as root, it makes the folders above the repository accessible to other users until it ends.
set -euo pipefail
cd "$(dirname "$0")/.."
repository=$PWD
# `make test` checks that no requirement is missing. Tests whose requirements that user can't access are skipped here, and reported.
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

built="$("${CARGO:-cargo}" test --release --locked --workspace --no-run 2>&1)" || {
    echo "$built" >&2
    exit 1
}
# Paths of the test binaries, those with unit tests first.
unit_tests="$(sed -nE 's#^ *Executable unittests src/[^ ]+ \((.*)\)$#\1#p' <<<"$built")"
integration_tests="$(sed -nE 's#^ *Executable tests/[^ ]+ \((.*)\)$#\1#p' <<<"$built")"

failed=()
# Runs the test binaries $2 with the command $1 and the arguments $3…, and prints the missing requirements of skipped tests.
run() {
    local as=$1 binaries=$2 binary
    shift 2
    : >"$GLOBALSPLAT_SKIPPED"
    chmod a+rw "$GLOBALSPLAT_SKIPPED"
    for binary in $binaries; do
        echo "$as: ${binary##*/} $*"
        "$as" "$(realpath "$binary")" --quiet "$@" </dev/null || failed+=("$as: ${binary##*/}")
    done
    [ ! -s "$GLOBALSPLAT_SKIPPED" ] || echo "$as: skipped, missing: $(sort -u "$GLOBALSPLAT_SKIPPED" | paste -sd , | sed 's/,/, /g')"
}

# A locale whose letters and numbers differ most from English, if it is installed.
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

# Copies the files that git tracks, and links what was built and installed.
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
    # Tests that need torchrun are skipped if Python is in a folder that user can't access, such as root's home. The check runs Python
    # through `env`, because the first program that setpriv starts can access more than the programs after it.
    as_ordinary env .venv/bin/python -c '' 2>/dev/null || {
        echo "as_ordinary: without torchrun, because this user can't run .venv/bin/python"
        local -x TORCHRUN=/nonexistent
    }
    if [ $# -gt 0 ]; then
        run as_ordinary "$unit_tests $integration_tests" "$@"
        return
    fi
    # Slow tests that don't depend on these conditions are left out: output of compilers and other programs, reductions across processes.
    run as_ordinary "$unit_tests $integration_tests" --skip cuda:: --skip distributed:: --skip viewers::
    echo "as_ordinary: demo"
    OUT="$folder/a folder/tmp/demo" CAPTURES=none as_ordinary scripts/demo.sh --dry-run || failed+=("as_ordinary: demo")
}

run_small() {
    run as_small "$unit_tests"
    run as_small "$integration_tests" splat:: model:: refine:: examples::
}

case "${1:-all}" in
ordinary | small) "run_$1" "${@:2}" ;;
all)
    run_ordinary
    run_small
    ;;
*)
    echo "other_machines: unknown machine $1, expected ordinary or small" >&2
    exit 2
    ;;
esac
[ ${#failed[@]} -eq 0 ] || {
    printf 'other_machines: failed: %s\n' "${failed[@]}" >&2
    exit 1
}
