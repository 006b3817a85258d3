# For scripts of checks that need what can't always be installed; sourced. skip SCRIPT WHAT WHY: among other tests that may be skipped, this is
# counted, otherwise it is an error.
skip() {
    echo "$1: $3" >&2
    [ -n "${GLOBALSPLAT_SKIPPED:-}" ] && [ -z "${GLOBALSPLAT_NO_SKIPS:-}" ] || exit 2
    echo "$2" >>"$GLOBALSPLAT_SKIPPED"
    exit 0
}
