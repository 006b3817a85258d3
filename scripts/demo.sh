#!/usr/bin/env bash
# Reconstructs a splat from photos with the shipped weights, refines it for half a minute, and writes an interactive viewer page. Takes
# less than 3 minutes on two slow CPU cores.
#   scripts/demo.sh
#   scripts/demo.sh --training    fine-tunes the shipped weights for some minutes instead, and compares before and after
#   scripts/demo.sh [--training] --dry-run    runs the same commands at a reduced size, as a smoke test
#   CAPTURES  a capture, or a folder with captures or chunks up to two folders deep; by default $GLOBALSPLAT_CAPTURES, or else synthetic
#             scenes. Training uses all of them, and the first one is shown
#   OUT       output folder; by default runs/demo, or runs/demo_training. Files of an earlier demo in it are replaced
#   DEVICE    device to compute on, cpu or cuda; by default cpu
set -euo pipefail
cd "$(dirname "$0")/.."
globalsplat="target/release/globalsplat"
training=false out=runs/demo frames=32 size=192 seconds=30 scenes_made=1 settings=()
for argument in "$@"; do
    case "$argument" in
    --training) training=true out=runs/demo_training scenes_made=4 ;;
    --dry-run)
        scenes_made=1 frames=9 size=32 seconds=0.1
        settings=(--set train.steps=2 --set train.validate_every=1 --set data.context_views=2 --set data.min_context_views=2)
        ;;
    *)
        echo "demo: unknown argument $argument, expected --training or --dry-run" >&2
        exit 2
        ;;
    esac
done
out="${OUT:-$out}"
device="${DEVICE:-cpu}"
captures="${CAPTURES:-${GLOBALSPLAT_CAPTURES:-none}}"
# Remove an earlier demo's files, because training would resume from them and old scenes would be reused. A folder that no demo created
# is left alone.
mark="$out/.made_by_the_demo"
if [ -e "$mark" ]; then
    rm -rf "$out"/{worlds,evaluation,shipped,refined,training,trained,model.safetensors}
elif [ -n "$(ls -A "$out" 2>/dev/null)" ]; then
    echo "demo: $out: found other files, expected an empty folder or the output of an earlier demo" >&2
    exit 2
fi
mkdir -p "$out"
touch "$mark"

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
    echo "demo: generating synthetic scenes" >&2
    captures="$out/worlds"
    "$globalsplat" synth --out "$captures" --seed 7 --scenes "$scenes_made" --frames "$frames" --size "$size"
    scene="$(find_scene "$captures")"
fi
name="$(basename "${scene##*#}")"

# Writes the splat, held-out views and orbit of the scene, reconstructed with the weights $1, to the folder $2.
show() {
    mkdir -p "$2"
    "$globalsplat" reconstruct --device "$device" --weights "$1" --scene "$scene" --holdout every:3+1 --out "$2/$name.ply"
    "$globalsplat" eval --device "$device" --weights "$1" --scene "$scene" --holdout every:3+1 --views 24 --contact-sheet "$2/${name}_held_out.png" >/dev/null
    "$globalsplat" render --splat "$2/$name.ply" --scene "$scene" --orbit --depth --size 256x256 --out "$2/${name}_orbit.gif" >/dev/null
}
show models/tiny.safetensors "$out/shipped"
echo "LOOK: $out/shipped/${name}_held_out.png has held-out views (photo, ours, depth), ${name}_orbit.gif an orbit," \
    "$name.ply the splat for any 3DGS viewer"

if ! $training; then
    refined="$out/refined/$name"
    mkdir -p "$out/refined"
    "$globalsplat" refine --scene "$scene" --holdout every:3+1 --seconds "$seconds" --contact-sheet "${refined}_held_out.png" --out "$refined.ply"
    echo "LOOK: ${refined}_held_out.png has the same views after $seconds s of refinement on these photos, without weights"
    if "$globalsplat" render --splat "$refined.ply" --scene "$scene" --html "$refined.html" >/dev/null; then
        echo "LOOK: $refined.html is an interactive viewer, for any browser"
    fi
    exit
fi

echo "demo: fine-tuning the shipped weights on two thirds of these photos, which takes some minutes" >&2
"$globalsplat" train --device "$device" --config configs/fine_tune.toml --from models/tiny.safetensors --set "data.captures=[\"$captures\"]" \
    ${settings[@]+"${settings[@]}"} --out "$out/training"
"$globalsplat" export --run "$out/training" --out "$out/model.safetensors"
show "$out/model.safetensors" "$out/trained"
echo "LOOK: $out/training/curves.svg has both curves, in training and held out; $out/trained the same views as $out/shipped, after training"
if [ -e "$captures/evaluation_index.json" ]; then
    # Compare the weights on all synthetic scenes, in one report.
    for weights in shipped:models/tiny.safetensors trained:"$out/model.safetensors"; do
        "$globalsplat" eval --device "$device" --weights "${weights#*:}" --data "$captures" --index "$captures/evaluation_index.json" \
            --name "${weights%%:*} weights" --out "$out/evaluation/${weights%%:*}"
    done
    "$globalsplat" report "$out/evaluation/shipped" "$out/evaluation/trained" --out "$out/evaluation/report.html"
    echo "LOOK: $out/evaluation/report.html compares their scores, views and depths"
fi
