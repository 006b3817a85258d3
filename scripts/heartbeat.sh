#!/usr/bin/env bash
# Runs a command, and prints every 30 seconds that it is still running:
#   heartbeat.sh building cargo build …              only if standard error is not a terminal, where cargo shows progress itself
#   heartbeat.sh --always installing pip install …   in a terminal, too
set -uo pipefail
always=false
if [ "$1" = --always ]; then
    always=true
    shift
fi
what=$1
shift
[ ! -t 2 ] || $always || exec "$@"

# Prints the crates and C++ files that this command's compilers are compiling now.
compiled() {
    ps -eo pgid=,args= | awk -v group="$(ps -o pgid= $$ | tr -d ' ')" '
        $1 != group { next }
        $2 ~ /rustc$/ && match($0, /--crate-name [^ ]+/) { name = substr($0, RSTART + 13, RLENGTH - 13) }
        $2 ~ /cc1plus$/ && match($0, /[^ \/]+\.(cpp|cc)( |$)/) { name = substr($0, RSTART, RLENGTH); sub(/ $/, "", name) }
        name != "" && name != "build_script_build" && !seen[name]++ { names = names (names == "" ? "" : ", ") name }
        { name = "" }
        END { print names }'
}

# Prints until the command ends: the command holds the other end of this function's standard input, and writes nothing to it.
beat() {
    local now
    while read -rt 30; [ $? -gt 128 ] && kill -0 $$ 2>/dev/null; do
        now="$(compiled)"
        echo "$what: $((SECONDS / 60)) min $((SECONDS % 60)) s so far${now:+, now $now}"
    done
}

exec 9> >(beat >&2)
# Replace this shell, so that the command receives signals itself and its exit code is returned.
exec "$@"
