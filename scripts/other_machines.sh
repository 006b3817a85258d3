#!/usr/bin/env bash
# Runs tests again under the conditions of other machines:
#   scripts/other_machines.sh            runs both `ordinary` and `small`
#   scripts/other_machines.sh ordinary   tests on AVX2 without AVX-512 and bf16, as a user who isn't root and has no home, in a
#                                        folder with a space that only its owner may write to, in another language and time zone,
#                                        without standard input; then the demo at a reduced size
#   scripts/other_machines.sh small      tests of numerical code, on one core with SSE2
#   scripts/other_machines.sh ordinary view splat    only view.rs and splat.rs of the `ordinary` tests
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

# The tests given by name, or all if none is given: a file tests/*/NAME.rs, or lib and main, the unit tests of the library and the program.
chosen=("${@:2}")
for name in "${chosen[@]}"; do
    [[ " lib main " == *" $name "* ]] || compgen -G "tests/*/$name.rs" >/dev/null || compgen -G "crates/*/tests/$name.rs" >/dev/null || {
        echo "other_machines: there is no test $name, expected lib, main or the name of a file in a folder of tests/" >&2
        exit 2
    }
done
built="$("${CARGO:-cargo}" test --release --locked --workspace --no-run 2>&1)" || {
    echo "$built" >&2
    exit 1
}
# One line per test binary: its name (lib and main for unit tests, the name of a folder in tests/, or file: and the name of a file in the
# tests/ of a crate) and its path.
tests="$(sed -nE \
    -e 's#^ *Executable unittests src/(lib|main)\.rs \((.*)\)$#\1 \2#p' \
    -e 's#^ *Executable tests/([a-z]+)/main\.rs \((.*)\)$#\1 \2#p' \
    -e 's#^ *Executable tests/([a-z_]+)\.rs \((.*)\)$#file:\1 \2#p' <<<"$built")"

# Tests that do not depend on these conditions and are slow: output of compilers and other programs, reductions across processes. They run
# here only if given by name.
alike=(cuda distributed viewers)

failed=()
# Runs the tests $2…, or all tests, with the command $1, limited to the chosen ones. Prints the missing requirements of skipped tests.
run() {
    local as=$1 name binary filters ran=false
    shift
    : >"$GLOBALSPLAT_SKIPPED"
    chmod a+rw "$GLOBALSPLAT_SKIPPED"
    while read -r name binary; do
        filters=()
        case "$name" in
        lib | main | file:*)
            [[ $# -eq 0 || " $* " == *" ${name#file:} "* ]] || continue
            [[ ${#chosen[@]} -eq 0 || " ${chosen[*]} " == *" ${name#file:} "* ]] || continue
            ;;
        *)
            local file module
            for file in tests/"$name"/*.rs; do
                module="$(basename "$file" .rs)"
                [[ $module != main ]] || continue
                [[ $# -eq 0 || " $* " == *" $module "* ]] || continue
                if [ ${#chosen[@]} -gt 0 ]; then
                    [[ " ${chosen[*]} " == *" $module "* ]] || continue
                else
                    [[ " ${alike[*]} " != *" $module "* ]] || continue
                fi
                filters+=("$module::")
            done
            [ ${#filters[@]} -gt 0 ] || continue
            ;;
        esac
        [ "${binary:0:1}" = / ] || binary="$repository/$binary"
        echo "$as: $name ${filters[*]}"
        ran=true
        "$as" "$binary" --quiet "${filters[@]}" </dev/null || failed+=("$as: $name")
    done <<<"$tests"
    $ran || {
        echo "other_machines: $as has no test named ${chosen[*]}" >&2
        exit 2
    }
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
    echo "other_machines: unknown machine $1, expected ordinary or small" >&2
    exit 2
    ;;
esac
[ ${#failed[@]} -eq 0 ] || {
    printf 'other_machines: failed: %s\n' "${failed[@]}" >&2
    exit 1
}
