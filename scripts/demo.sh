#!/usr/bin/env bash
# Reconstructs a splat from photos with the shipped weights, refines it for half a minute, and writes an interactive viewer page. Takes
# less than 3 minutes on two slow CPU cores.
#   scripts/demo.sh
#   scripts/demo.sh --training    fine-tunes the shipped weights on these scenes for some minutes instead, and compares before and after
#   scripts/demo.sh [--training] --dry-run    runs the same commands at a reduced size, as a smoke test
#   CAPTURES  a capture, or a folder with captures or chunks up to two folders deep; by default $GLOBALSPLAT_CAPTURES, or else synthetic
#             scenes. The demo refines the first scene
#   OUT       output folder; by default runs/demo, or runs/demo_training. Files of an earlier demo in it are replaced
#   DEVICE    device to compute on, cpu or cuda; by default cpu
set -euo pipefail
cd "$(dirname "$0")/.."
globalsplat="target/release/globalsplat"
training=false
small=false
for argument in "$@"; do
    case "$argument" in
    --training) training=true ;;
    --dry-run) small=true ;;
    *)
        echo "demo: unknown argument $argument, expected --training or --dry-run" >&2
        exit 2
        ;;
    esac
done
out="${OUT:-runs/demo}"
scenes_made=1
if $training; then
    out="${OUT:-runs/demo_training}"
    scenes_made=4
fi
device="${DEVICE:-cpu}"
captures="${CAPTURES:-${GLOBALSPLAT_CAPTURES:-none}}"
captures="${captures%/}"
frames=32 size=192 seconds=30 settings=()
if $small; then
    scenes_made=1 frames=9 size=32 seconds=0.1
    settings=(--set train.steps=2 --set train.validate_every=1 --set data.context_views=2 --set data.min_context_views=2)
fi
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

# Collects the captures in the folder $1 and the first scenes of each set of chunks in it. Folders inside a capture are not searched.
find_scenes() {
    local folder what found=""
    scenes=()
    while IFS= read -r folder; do
        case "$folder/" in "${found:-/dev/null}"/*) continue ;; esac
        what="$("$globalsplat" inspect "$folder" --json 2>/dev/null)" || continue
        case "$what" in
        *'"kind":"capture"'*) scenes+=("$folder") ;;
        *)
            [ -e "$folder/index.json" ] || continue
            # The first few entries of {"key": "chunk", …}.
            while IFS='"' read -r _ key _ chunk _; do
                scenes+=("$folder/$chunk#$key")
            done < <(grep -o '"[^"]*" *: *"[^"]*\.torch"' "$folder/index.json" | head -n 4)
            ;;
        esac
        found="$folder"
    done < <(find -L "$1" -maxdepth 2 -type d | LC_ALL=C sort)
}

# Prints the base name of a scene's files.
name_of() {
    local name="${1#"$captures"/}"
    [ "$1" != "$captures" ] || name="$(basename "$1")"
    name="${name##*#}"
    echo "${name//\//_}"
}

# Writes the splat, held-out views and orbit of the scene $1, reconstructed with the weights $2, to the folder $3.
show() {
    local name
    name="$(name_of "$1")"
    mkdir -p "$3"
    "$globalsplat" reconstruct --device "$device" --weights "$2" --scene "$1" --holdout every:3+1 --out "$3/$name.ply"
    "$globalsplat" eval --device "$device" --weights "$2" --scene "$1" --holdout every:3+1 --views 24 --contact-sheet "$3/${name}_held_out.png" >/dev/null
    "$globalsplat" render --splat "$3/$name.ply" --scene "$1" --orbit --depth --size 256x256 --out "$3/${name}_orbit.gif" >/dev/null
}

scenes=()
[ "$captures" = none ] || find_scenes "$captures"
if [ ${#scenes[@]} -eq 0 ]; then
    [ "$captures" = none ] || echo "demo: no capture found in $captures" >&2
    echo "demo: generating synthetic scenes" >&2
    captures="$out/worlds"
    "$globalsplat" synth --out "$captures" --seed 7 --scenes "$scenes_made" --frames "$frames" --size "$size"
    find_scenes "$captures"
fi
first="$(name_of "${scenes[0]}")"

if ! $training; then
    show "${scenes[0]}" models/tiny.safetensors "$out/shipped"
    echo "LOOK: $out/shipped/${first}_held_out.png has held-out views (photo, ours, depth), ${first}_orbit.gif an orbit," \
        "${first}.ply the splat for any 3DGS viewer"
    mkdir -p "$out/refined"
    "$globalsplat" refine --scene "${scenes[0]}" --holdout every:3+1 --seconds "$seconds" --contact-sheet "$out/refined/${first}_held_out.png" \
        --out "$out/refined/$first.ply"
    echo "LOOK: $out/refined/${first}_held_out.png has the same views after $seconds s of refinement on these photos, without weights"
    if "$globalsplat" doctor --json | grep -q '"viewer": *true'; then
        "$globalsplat" render --splat "$out/refined/$first.ply" --scene "${scenes[0]}" --html "$out/refined/$first.html" >/dev/null
        echo "LOOK: $out/refined/$first.html is an interactive viewer, for any browser"
    fi
    exit
fi

# Every third view is held out, and training takes six context views.
train_on=()
for scene in "${scenes[@]}"; do
    photos="$("$globalsplat" inspect "$scene" --json | sed -n 's/.*"views":\([0-9]*\).*/\1/p')"
    [ "$photos" -lt 9 ] || train_on+=("$scene")
done
if [ ${#train_on[@]} -eq 0 ]; then
    echo "demo: none of these scenes has the 9 photos that training needs" >&2
    exit 2
fi
for scene in "${train_on[@]}"; do
    show "$scene" models/tiny.safetensors "$out/shipped"
done
echo "demo: fine-tuning the shipped weights on two thirds of these photos, which takes some minutes" >&2
list="$(printf ', "%s"' "${train_on[@]}")"
"$globalsplat" train --device "$device" --config configs/fine_tune.toml --from models/tiny.safetensors --set "data.captures=[${list#, }]" \
    ${settings[@]+"${settings[@]}"} --out "$out/training"
"$globalsplat" export --run "$out/training" --out "$out/model.safetensors"
for scene in "${train_on[@]}"; do
    show "$scene" "$out/model.safetensors" "$out/trained"
done
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
