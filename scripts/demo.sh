#!/usr/bin/env bash
# Photos to a splat by the weights that come with the program, one made sharp in half a minute, then a few minutes of training on
# these scenes, on two CPU cores.
#   scripts/demo.sh
#   scripts/demo.sh --dry-run    the same commands in small, to see that they work
#   CAPTURES  a capture, or a folder with captures or chunks up to two folders deep; by default $GLOBALSPLAT_CAPTURES, else made-up
#             worlds
#   OUT       where everything goes; by default runs/demo. What an earlier demo left there is made anew
#   DEVICE    what computes, cpu or cuda; by default cpu
set -euo pipefail
cd "$(dirname "$0")/.."
globalsplat="target/release/globalsplat"
out="${OUT:-runs/demo}"
device="${DEVICE:-cpu}"
captures="${CAPTURES:-${GLOBALSPLAT_CAPTURES:-none}}"
captures="${captures%/}"
worlds=4 frames=32 size=192 seconds=30 small=()
if [ "${1:-}" = --dry-run ]; then
    worlds=1 frames=9 size=32 seconds=0.1
    small=(--set train.steps=2 --set train.validate_every=1 --set data.context_views=2 --set data.fewest_context_views=2)
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
        "$globalsplat" eval --device "$device" --weights "$1" --scene "$scene" --holdout every:3+1 --views 24 --sheet "$2/${name}_held_out.png" >/dev/null
        "$globalsplat" render --splat "$2/$name.ply" --scene "$scene" --orbit --depth --size 256x256 --out "$2/${name}_orbit.gif" >/dev/null
    done
}

scenes=()
[ "$captures" = none ] || find_scenes "$captures"
if [ ${#scenes[@]} -eq 0 ]; then
    [ "$captures" = none ] || echo "demo: there is no capture in $captures" >&2
    echo "demo: worlds are made up and filmed" >&2
    captures="$out/worlds"
    "$globalsplat" synth --out "$captures" --seed 7 --scenes "$worlds" --frames "$frames" --size "$size"
    find_scenes "$captures"
    # Judged over all of them, on one page.
    "$globalsplat" eval --device "$device" --weights models/tiny.safetensors --data "$captures" --index "$captures/evaluation_index.json" \
        --name "weights that come with it" --out "$out/evaluation"
fi
show models/tiny.safetensors "$out/shipped"
[ ! -e "$out/evaluation/report.html" ] || echo "LOOK: $out/evaluation/report.html has their scores, views and depths"
first="$(name_of "${scenes[0]}")"
echo "LOOK: $out/shipped/${first}_held_out.png has views never shown (photo, ours, depth), ${first}_orbit.gif a look around," \
    "${first}.ply the splat for any 3DGS viewer"
if "$globalsplat" doctor --json | grep -q '"viewer": *true'; then
    "$globalsplat" render --splat "$out/shipped/$first.ply" --scene "${scenes[0]}" --html "$out/shipped/$first.html" >/dev/null
    echo "LOOK: $out/shipped/$first.html is a page to walk in, for any browser"
fi

mkdir -p "$out/refined"
"$globalsplat" refine --scene "${scenes[0]}" --holdout every:3+1 --seconds "$seconds" --sheet "$out/refined/${first}_held_out.png" \
    --out "$out/refined/$first.ply"
echo "LOOK: $out/refined/${first}_held_out.png has the same views after $seconds s that need no weights, only these photos"

# A third is held out, and training shows six.
train_on=()
for scene in "${scenes[@]}"; do
    photos="$("$globalsplat" inspect "$scene" --json | sed -n 's/.*"views":\([0-9]*\).*/\1/p')"
    [ "$photos" -lt 9 ] || train_on+=("$scene")
done
if [ ${#train_on[@]} -eq 0 ]; then
    echo "demo: to train on takes 9 photos of a scene, which none of these has" >&2
    exit 0
fi
echo "demo: the weights are trained on for some minutes, on two thirds of these photos" >&2
list="$(printf ', "%s"' "${train_on[@]}")"
"$globalsplat" train --device "$device" --config configs/fine_tune.toml --from models/tiny.safetensors --set "data.captures=[${list#, }]" \
    ${small[@]+"${small[@]}"} --out "$out/training"
"$globalsplat" export --run "$out/training" --out "$out/model.safetensors"
show "$out/model.safetensors" "$out/trained"
echo "LOOK: $out/training/curves.svg has both curves, in training and held out; $out/trained the same views as $out/shipped, after training"
