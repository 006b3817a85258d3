#!/usr/bin/env bash
# Runs a command that runs tests, then prints how many tests were skipped and which requirements they lacked, and exits with the
# command's exit code:
#   count_skips.sh make checks
# A skipped test appends a line with the missing requirement to the file GLOBALSPLAT_SKIPPED.
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
