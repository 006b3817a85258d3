#!/usr/bin/env bash
# Photos to a splat by the weights that come with the program, one made sharp in half a minute, then a few minutes of training on
# these scenes, on two CPU cores.
#   CAPTURES  a capture, or a folder with captures up to two folders deep; by default $GLOBALSPLAT_CAPTURES, else made-up worlds
#   OUT       where everything goes; by default runs/demo
#   DEVICE    what computes, cpu or cuda; by default cpu
set -euo pipefail
cd "$(dirname "$0")/.."
globalsplat="target/release/globalsplat"
out="${OUT:-runs/demo}"
device="${DEVICE:-cpu}"
captures="${CAPTURES:-${GLOBALSPLAT_CAPTURES:-none}}"
captures="${captures%/}"
mkdir -p "$out"

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

# What a scene's files are called.
name_of() {
    local name="${1#"$captures"/}"
    [ "$1" != "$captures" ] || name="$(basename "$1")"
    name="${name##*#}"
    echo "${name//\//_}"
}

# Splat, views never shown and orbit of every scene, by the weights $1, in the folder $2.
show() {
    local scene name
    mkdir -p "$2"
    for scene in "${scenes[@]}"; do
        name="$(name_of "$scene")"
        "$globalsplat" reconstruct --device "$device" --weights "$1" --scene "$scene" --holdout every:3+1 --out "$2/$name.ply"
        "$globalsplat" eval --device "$device" --weights "$1" --scene "$scene" --holdout every:3+1 --views 12 --sheet "$2/${name}_held_out.png" >/dev/null
        "$globalsplat" render --splat "$2/$name.ply" --scene "$scene" --orbit --depth --size 256x256 --out "$2/${name}_orbit.gif" >/dev/null
    done
}

scenes=()
[ "$captures" = none ] || find_scenes "$captures"
train_on=("${scenes[@]}")
if [ ${#scenes[@]} -eq 0 ]; then
    [ "$captures" = none ] || echo "demo: there is no capture in $captures" >&2
    echo "demo: worlds are made up and filmed" >&2
    captures="$out/worlds"
    "$globalsplat" synth --out "$captures" --seed 7 --scenes 4 --frames 32 --size 192
    for number in 0 1 2 3; do scenes+=("$captures/000000.torch#7_00000$number"); done
    train_on=("$captures")
    # Judged over all of them, on one page.
    "$globalsplat" eval --device "$device" --weights models/tiny.safetensors --data "$captures" --index "$captures/evaluation_index.json" \
        --name "weights that come with it" --out "$out/evaluation"
fi
show models/tiny.safetensors "$out/shipped"
first="$(name_of "${scenes[0]}")"
echo "LOOK: $out/shipped/${first}_held_out.png has views never shown (photo, ours, depth), ${first}_orbit.gif a look around," \
    "${first}.ply the splat for any 3DGS viewer"
if "$globalsplat" doctor --json | grep -q '"viewer": *true'; then
    "$globalsplat" render --splat "$out/shipped/$first.ply" --scene "${scenes[0]}" --html "$out/shipped/$first.html" >/dev/null
    echo "LOOK: $out/shipped/$first.html is a page to walk in, for any browser"
fi

mkdir -p "$out/refined"
"$globalsplat" refine --scene "${scenes[0]}" --holdout every:3+1 --seconds 30 --sheet "$out/refined/${first}_held_out.png" \
    --out "$out/refined/$first.ply"
echo "LOOK: $out/refined/${first}_held_out.png has the same views after 30 s that need no weights, only these photos"

echo "demo: the weights are trained on for some minutes, on two thirds of these photos" >&2
list="$(printf ', "%s"' "${train_on[@]}")"
"$globalsplat" train --device "$device" --config configs/fine_tune.toml --from models/tiny.safetensors --set "data.captures=[${list#, }]" --out "$out/training"
"$globalsplat" export --run "$out/training" --out "$out/model.safetensors"
show "$out/model.safetensors" "$out/trained"
echo "LOOK: $out/training/curves.svg has both curves, in training and held out; $out/trained the same views as $out/shipped, after training"
