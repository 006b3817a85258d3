#!/usr/bin/env bash
# Runs a command that runs tests, says last how many of them were skipped, and for want of what, and ends with the command's exit code:
#   count_skips.sh make checks
# A test that is skipped adds a line to the file GLOBALSPLAT_SKIPPED, which says what wasn't there.
set -euo pipefail
GLOBALSPLAT_SKIPPED=$(mktemp)
export GLOBALSPLAT_SKIPPED
trap 'rm -f "$GLOBALSPLAT_SKIPPED"' EXIT

status=0
"$@" || status=$?
sort "$GLOBALSPLAT_SKIPPED" | uniq -c | awk '
    { count = $1; total += count; sub(/^ *[0-9]+ /, ""); list = list (list == "" ? ": " : ", ") $0 " (" count ")" }
    END { print total + 0, (total == 1 ? "test" : "tests"), "skipped" list }'
exit $status
