#!/usr/bin/env bash
# Photos to a splat: by the shipped weights, then refined for half a minute, and a page to walk in. Less than 3 minutes on two
# slow CPU cores.
#   scripts/demo.sh
#   scripts/demo.sh --training    instead trains the shipped weights on these scenes for some minutes, and compares
#   scripts/demo.sh [--training] --dry-run    the same commands in small, to see that they work
#   CAPTURES  a capture, or a folder with captures or chunks up to two folders deep; by default $GLOBALSPLAT_CAPTURES, else synthetic
#             scenes. The demo refines the first of them
#   OUT       where everything goes; by default runs/demo, or runs/demo_training. An earlier demo's files there are replaced
#   DEVICE    what computes, cpu or cuda; by default cpu
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
        echo "demo: $argument is no argument, expected --training or --dry-run" >&2
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
    settings=(--set train.steps=2 --set train.validate_every=1 --set data.context_views=2 --set data.fewest_context_views=2)
fi
# Others' scenes and an earlier training would be gone on with. What no demo made is nobody's to remove.
mark="$out/.made_by_the_demo"
if [ -e "$mark" ]; then
    rm -rf "$out"/{worlds,evaluation,shipped,refined,training,trained,model.safetensors}
elif [ -n "$(ls -A "$out" 2>/dev/null)" ]; then
    echo "demo: $out: it holds other things, expected an empty folder or an earlier demo's" >&2
    exit 2
fi
mkdir -p "$out"
touch "$mark"

# Captures in the folder $1, and the first scenes of chunks in it; what lies inside of one isn't another.
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
            # Of {"key": "chunk", …} the first few.
            while IFS='"' read -r _ key _ chunk _; do
                scenes+=("$folder/$chunk#$key")
            done < <(grep -o '"[^"]*" *: *"[^"]*\.torch"' "$folder/index.json" | head -n 4)
            ;;
        esac
        found="$folder"
    done < <(find -L "$1" -maxdepth 2 -type d | LC_ALL=C sort)
}

# What a scene's files are called.
name_of() {
    local name="${1#"$captures"/}"
    [ "$1" != "$captures" ] || name="$(basename "$1")"
    name="${name##*#}"
    echo "${name//\//_}"
}

# Splat, held-out views and orbit of the scene $1, by the weights $2, in the folder $3.
show() {
    local name
    name="$(name_of "$1")"
    mkdir -p "$3"
    "$globalsplat" reconstruct --device "$device" --weights "$2" --scene "$1" --holdout every:3+1 --out "$3/$name.ply"
    "$globalsplat" eval --device "$device" --weights "$2" --scene "$1" --holdout every:3+1 --views 24 --sheet "$3/${name}_held_out.png" >/dev/null
    "$globalsplat" render --splat "$3/$name.ply" --scene "$1" --orbit --depth --size 256x256 --out "$3/${name}_orbit.gif" >/dev/null
}

scenes=()
[ "$captures" = none ] || find_scenes "$captures"
if [ ${#scenes[@]} -eq 0 ]; then
    [ "$captures" = none ] || echo "demo: there is no capture in $captures" >&2
    echo "demo: synthetic scenes are made" >&2
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
    "$globalsplat" refine --scene "${scenes[0]}" --holdout every:3+1 --seconds "$seconds" --sheet "$out/refined/${first}_held_out.png" \
        --out "$out/refined/$first.ply"
    echo "LOOK: $out/refined/${first}_held_out.png has the same views after $seconds s of refinement on these photos, without weights"
    if "$globalsplat" doctor --json | grep -q '"viewer": *true'; then
        "$globalsplat" render --splat "$out/refined/$first.ply" --scene "${scenes[0]}" --html "$out/refined/$first.html" >/dev/null
        echo "LOOK: $out/refined/$first.html is a page to walk in, for any browser"
    fi
    exit
fi

# Every third view is held out, and training shows six.
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
echo "demo: the shipped weights are trained for some minutes, on two thirds of these photos" >&2
list="$(printf ', "%s"' "${train_on[@]}")"
"$globalsplat" train --device "$device" --config configs/fine_tune.toml --from models/tiny.safetensors --set "data.captures=[${list#, }]" \
    ${settings[@]+"${settings[@]}"} --out "$out/training"
"$globalsplat" export --run "$out/training" --out "$out/model.safetensors"
for scene in "${train_on[@]}"; do
    show "$scene" "$out/model.safetensors" "$out/trained"
done
echo "LOOK: $out/training/curves.svg has both curves, in training and held out; $out/trained the same views as $out/shipped, after training"
if [ -e "$captures/evaluation_index.json" ]; then
    # All of the synthetic scenes, on one page.
    for weights in shipped:models/tiny.safetensors trained:"$out/model.safetensors"; do
        "$globalsplat" eval --device "$device" --weights "${weights#*:}" --data "$captures" --index "$captures/evaluation_index.json" \
            --name "${weights%%:*} weights" --out "$out/evaluation/${weights%%:*}"
    done
    "$globalsplat" report "$out/evaluation/shipped" "$out/evaluation/trained" --out "$out/evaluation/report.html"
    echo "LOOK: $out/evaluation/report.html compares their scores, views and depths"
fi
