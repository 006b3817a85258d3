#!/usr/bin/env bash
# The whole way in minutes on two CPU cores: trains a small model on the captures at hand (or on rooms it makes itself),
# then writes a splat, a side-by-side picture of views that training never showed, and an orbit.
#   CAPTURES  a folder of captures; by default $GLOBALSPLAT_CAPTURES, else ../shared/data
#   OUT       where everything goes; by default runs/demo
set -euo pipefail
cd "$(dirname "$0")/.."
globalsplat="target/release/globalsplat"
out="${OUT:-runs/demo}"
captures="${CAPTURES:-${GLOBALSPLAT_CAPTURES:-../shared/data}}"
[ -d "$captures/re10k" ] && captures="$captures/re10k"

is_capture() { "$globalsplat" inspect "$1" >/dev/null 2>&1; }
found=""
for scene in "$captures"/*/; do
    ! is_capture "$scene" || found=yes
done
if [ -z "$found" ]; then
    echo "demo: no captures in $captures, so rooms are made and photographed" >&2
    captures="$out/captures"
    "$globalsplat" synth --out "$captures" --scenes 2 --frames 12
fi
"$globalsplat" train --config configs/first_light.toml --set "data.captures=[\"$captures\"]" --out "$out"
"$globalsplat" export --run "$out" --out "$out/model.safetensors"

for scene in "$captures"/*/; do
    is_capture "$scene" || continue
    name="$(basename "$scene")"
    "$globalsplat" reconstruct --weights "$out/model.safetensors" --scene "$scene" --holdout every:3+1 --out "$out/$name.ply"
    "$globalsplat" eval --weights "$out/model.safetensors" --scene "$scene" --sheet "$out/${name}_held_out.png" >/dev/null
    "$globalsplat" render --splat "$out/$name.ply" --scene "$scene" --orbit --depth --size 256x256 --out "$out/${name}_orbit.gif" >/dev/null
    echo "$out/$name.ply                 the splat; any 3DGS viewer opens it"
    echo "$out/${name}_held_out.png      views never shown: photo, ours, depth"
    echo "$out/${name}_orbit.gif         a look around"
done
