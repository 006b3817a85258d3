#!/usr/bin/env bash
# Runs a command, and prints a line to standard error every 30 seconds while it runs:
#   heartbeat.sh LABEL COMMAND …            prints nothing if standard error is a terminal, where commands like cargo show their progress
#   heartbeat.sh --always LABEL COMMAND …   prints in a terminal, too
# LABEL begins each line; for example: heartbeat.sh building cargo build
set -uo pipefail
always=false
if [ "$1" = --always ]; then
    always=true
    shift
fi
label=$1
shift
[ ! -t 2 ] || $always || exec "$@"

# Prints a line every 30 seconds until the command ends. Standard input is a pipe whose other end the command holds open and never writes
# to, so that `read` times out while the command runs and fails at once when it ends.
print_heartbeats() {
    while read -rt 30; [ $? -gt 128 ] && kill -0 $$ 2>/dev/null; do
        echo "$label: $((SECONDS / 60)) min $((SECONDS % 60)) s so far"
    done
}

exec 9> >(print_heartbeats >&2)
# The command replaces this shell, so that it receives signals directly and its exit code is this script's.
exec "$@"
