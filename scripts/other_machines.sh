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

as_ordinary() {
    local other_user=()
    [ "$(id -u)" -ne 0 ] || other_user=(setpriv --reuid=65534 --regid=65534 --clear-groups)
    cd "$CLONE"
    umask 077
    # A locale whose letters and numbers differ most from English, if it is installed.
    exec env -u HOME -u TERM -u XDG_CACHE_HOME LC_ALL="$(locale -a 2>/dev/null | grep -im1 '^tr_TR' || echo C)" TZ=Pacific/Kiritimati \
        NO_COLOR=1 TMPDIR="$CLONE/../tmp" GLOBALSPLAT_SIMD=avx2 "${other_user[@]}" "$@" <&-
}

as_small() {
    local core
    core="$(taskset -cp $$ | sed -E 's/.*[ ,-]([0-9]+)$/\1/')"
    GLOBALSPLAT_SIMD=portable OMP_NUM_THREADS=1 exec taskset -c "$core" "$@"
}

# Cargo runs this script in place of each test binary.
if [ "${1:-}" = --as ]; then
    "as_$2" "${@:3}"
fi

# `make test` checks that no requirement is missing. Tests whose requirements that user can't access are skipped here, and reported.
unset GLOBALSPLAT_NO_SKIPS
folder="$(mktemp -d)"
export CLONE="$folder/a folder/globalsplat" GLOBALSPLAT_SKIPPED="$folder/skipped"
opened=()
end() {
    [ ${#opened[@]} -eq 0 ] || chmod o-x "${opened[@]}"
    rm -rf "$folder"
}
trap end EXIT
failed=0

# Runs tests as $1: the targets that the array `targets` names, with the arguments $2….
targets=(--lib --bins --tests)
run() {
    : >"$GLOBALSPLAT_SKIPPED"
    chmod a+rw "$GLOBALSPLAT_SKIPPED"
    "${CARGO:-cargo}" test --release --locked --workspace --exclude globalsplat-python --no-fail-fast "${targets[@]}" \
        --config "target.'cfg(unix)'.runner = ['$repository/scripts/other_machines.sh', '--as', '$1']" -- --quiet "${@:2}" || failed=1
    [ ! -s "$GLOBALSPLAT_SKIPPED" ] || echo "$1: skipped, missing: $(sort -u "$GLOBALSPLAT_SKIPPED" | paste -sd , | sed 's/,/, /g')"
}

# Copies the files that git tracks, and links what was built and installed.
make_clone() {
    local made above=$repository
    mkdir -p "$CLONE" "$CLONE/../tmp"
    git ls-files -z | xargs -0 cp --parents -t "$CLONE"
    for made in target weights .venv web/dist parity/npm/node_modules; do
        [ ! -e "$made" ] || ln -s "$repository/$made" "$CLONE/$made"
    done
    chmod -R a+rX,go-w "$folder"
    chmod 1777 "$CLONE/../tmp"
    while [ "$(id -u)" -eq 0 ] && [ "$above" != / ]; do
        if (((8#$(stat -c %a "$above") & 1) == 0)); then
            chmod o+x "$above"
            opened+=("$above")
        fi
        above="$(dirname "$above")"
    done
}

run_ordinary() {
    make_clone
    # Tests that need torchrun are skipped if Python is in a folder that user can't access, such as root's home. The check runs Python
    # through `env`, because the first program that setpriv starts can access more than the programs after it.
    (as_ordinary env .venv/bin/python -c '') 2>/dev/null || {
        echo "ordinary: without torchrun, because this user can't run .venv/bin/python"
        local -x TORCHRUN=/nonexistent
    }
    if [ $# -gt 0 ]; then
        run ordinary "$@"
        return
    fi
    # Slow tests that don't depend on these conditions are left out: output of compilers and other programs, reductions across processes.
    run ordinary --skip cuda:: --skip distributed:: --skip viewers::
    (OUT="$CLONE/../tmp/demo" CAPTURES=none as_ordinary scripts/demo.sh --dry-run) || failed=1
}

run_small() {
    targets=(--lib)
    run small
    targets=(--tests)
    run small splat:: model:: refine:: examples::
}

# Tests run the examples, which `--tests` doesn't build.
"${CARGO:-cargo}" build --release --locked --workspace --examples
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
[ "$failed" -eq 0 ] || echo "other_machines: tests failed" >&2
exit "$failed"
