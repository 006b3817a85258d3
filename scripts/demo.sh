#!/usr/bin/env bash
# The whole way in minutes on two CPU cores: trains a small model on the captures at hand (or on rooms it makes itself),
# then writes a splat, a side-by-side picture of views that training never showed, and an orbit.
#   CAPTURES  a capture, or a folder with captures up to two folders deep; by default $GLOBALSPLAT_CAPTURES, else none
#   OUT       where everything goes; by default runs/demo
set -euo pipefail
cd "$(dirname "$0")/.."
globalsplat="target/release/globalsplat"
out="${OUT:-runs/demo}"
captures="${CAPTURES:-${GLOBALSPLAT_CAPTURES:-none}}"

# Folders in $1 that are captures; what lies inside of one isn't another.
find_scenes() {
    local folder found=""
    scenes=()
    while IFS= read -r folder; do
        case "$folder/" in "${found:-/dev/null}"/*) continue ;; esac
        if "$globalsplat" inspect "$folder" >/dev/null 2>&1; then
            scenes+=("$folder")
            found="$folder"
        fi
    done < <(find -L "$1" -maxdepth 2 -type d | sort)
}

scenes=()
[ "$captures" = none ] || find_scenes "${captures%/}"
if [ ${#scenes[@]} -eq 0 ]; then
    [ "$captures" = none ] || echo "demo: there is no capture in $captures" >&2
    echo "demo: rooms are made and photographed" >&2
    captures="$out/captures"
    "$globalsplat" synth --gaussians --out "$captures" --scenes 2 --frames 12 --size 256
    find_scenes "$captures"
fi
list="$(printf ', "%s"' "${scenes[@]}")"
"$globalsplat" train --config configs/first_light.toml --set "data.captures=[${list#, }]" --out "$out"
"$globalsplat" export --run "$out" --out "$out/model.safetensors"

for scene in "${scenes[@]}"; do
    name="${scene#"${captures%/}"/}"
    [ "$scene" != "${captures%/}" ] || name="$(basename "$scene")"
    name="${name//\//_}"
    "$globalsplat" reconstruct --weights "$out/model.safetensors" --scene "$scene" --holdout every:3+1 --out "$out/$name.ply"
    "$globalsplat" eval --weights "$out/model.safetensors" --scene "$scene" --sheet "$out/${name}_held_out.png" >/dev/null
    "$globalsplat" render --splat "$out/$name.ply" --scene "$scene" --orbit --depth --size 256x256 --out "$out/${name}_orbit.gif" >/dev/null
    echo "$out/$name.ply                 the splat; any 3DGS viewer opens it"
    echo "$out/${name}_held_out.png      views never shown: photo, ours, depth"
    echo "$out/${name}_orbit.gif         a look around"
done
