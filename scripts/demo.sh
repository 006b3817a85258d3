#!/usr/bin/env bash
# Reconstructs a splat from photos with the shipped weights, refines it for half a minute, and writes an interactive viewer page. Takes
# less than 3 minutes on two slow CPU cores.
#   scripts/demo.sh
#   scripts/demo.sh --dry-run    runs the same commands at a reduced size, as a smoke test
#   CAPTURES  a capture, or a folder with captures or chunks up to two folders deep, of which the first is shown; by default
#             $GLOBALSPLAT_CAPTURES, or else a synthetic scene
#   OUT       output folder (default: runs/demo).
set -euo pipefail
cd "$(dirname "$0")/.."
globalsplat="target/release/globalsplat"
frames=32 size=192 seconds=30
case "${1:-}" in
"") ;;
--dry-run) frames=9 size=32 seconds=0.1 ;;
*)
    echo "demo: unknown argument $1, expected --dry-run" >&2
    exit 2
    ;;
esac
out="${OUT:-runs/demo}"
captures="${CAPTURES:-${GLOBALSPLAT_CAPTURES:-none}}"

# Prints the first capture in the folder $1, or the first scene of the first set of chunks.
find_scene() {
    local folder key chunk
    while IFS= read -r folder; do
        if [[ "$("$globalsplat" inspect "$folder" --json 2>/dev/null)" == *'"kind":"capture"'* ]]; then
            echo "$folder"
            return
        elif [ -e "$folder/index.json" ]; then
            # The first entry of {"key": "chunk", …}.
            IFS='"' read -r _ key _ chunk _ < <(grep -om 1 '"[^"]*" *: *"[^"]*\.torch"' "$folder/index.json")
            echo "$folder/$chunk#$key"
            return
        fi
    done < <(find -L "$1" -maxdepth 2 -type d | LC_ALL=C sort)
}

scene=""
[ "$captures" = none ] || scene="$(find_scene "$captures")"
if [ -z "$scene" ]; then
    [ "$captures" = none ] || echo "demo: no capture found in $captures" >&2
    world="$out/synthetic_$size"
    [ -e "$world/index.json" ] || "$globalsplat" synth --out "$world" --seed 7 --scenes 1 --frames "$frames" --size "$size"
    scene="$(find_scene "$world")"
fi
name="$(basename "${scene##*#}")"
shipped="$out/shipped/$name" refined="$out/refined/$name"
mkdir -p "$out/shipped" "$out/refined"
"$globalsplat" reconstruct --scene "$scene" --holdout every:3+1 --out "$shipped.ply"
"$globalsplat" eval --weights models/tiny.safetensors --scene "$scene" --holdout every:3+1 --views 24 --contact-sheet "${shipped}_held_out.png" >/dev/null
"$globalsplat" render --splat "$shipped.ply" --scene "$scene" --orbit --depth --size 256x256 --out "${shipped}_orbit.gif" >/dev/null
echo "LOOK: ${shipped}_held_out.png has held-out views (photo, ours, depth), ${name}_orbit.gif an orbit, $name.ply the splat for any 3DGS viewer"
"$globalsplat" refine --scene "$scene" --holdout every:3+1 --seconds "$seconds" --contact-sheet "${refined}_held_out.png" --out "$refined.ply"
echo "LOOK: ${refined}_held_out.png has the same views after $seconds s of refinement on these photos, without weights"
if "$globalsplat" render --splat "$refined.ply" --scene "$scene" --html "$refined.html" >/dev/null; then
    echo "LOOK: $refined.html is an interactive viewer, for any browser"
fi
