#!/usr/bin/env bash
# Runs the checks that need a GPU, the most important first: parity of all operations, memory and speed compared with the CPU, and
# training. If one fails, the others are still run.
#   scripts/on_a_gpu.sh [PATTERN…]              all parts on the first GPU, or those whose name matches a shell pattern, as in 'model*'
#   scripts/on_a_gpu.sh --dry-run [PATTERN…]    the same commands at a reduced size, a smoke test of a minute or two
#   DEVICE    cuda, cuda:N, or cpu to try the script without a GPU (default: cuda)
#   OUT       output folder; gets report.md and the log of each part (default: runs/on_a_gpu)
#   LIBTORCH  the libtorch to run with, if the program was built with another one's path
#   PYTHON    a Python with torch, for parity (default: .venv/bin/python)
# Fails if a part failed. `make gpu-bundle` packs the program for a machine that can't build it.
set -uo pipefail
cd "$(dirname "$0")/.."
device="${DEVICE:-cuda}"
out="${OUT:-runs/on_a_gpu}"
python="${PYTHON:-.venv/bin/python}"
globalsplat=target/release/globalsplat
[ -z "${LIBTORCH:-}" ] || export LD_LIBRARY_PATH="$LIBTORCH/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"

parity=() raster=(--repeats 100) large=(--gaussians 1000000 --cameras 1 --size 1920x1080 --repeats 20)
views=(24 12 36) repeats=50 model=() refine=() batch=4 steps=10 train=(--set train.steps=300)
if [ "${1:-}" = --dry-run ]; then
    shift
    parity=(--only 'rasterizer_float32')
    raster=(--gaussians 500 --cameras 2 --size 64x64 --repeats 2) large=(--gaussians 2000 --cameras 1 --size 128x64 --repeats 2)
    views=(2) repeats=2
    model=(--set 'data.image_size=[32,32]' --set model.patch_size=16 --set model.latents=16 --set model.width=32)
    refine=(--gaussians 500 --size 64x64)
    batch=1 steps=2 train=(--set train.steps=2 --set curriculum.full_capacity=true)
fi
patterns=("${@:-*}")

mkdir -p "$out"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
failed=0
echo "# $(date -u +%Y-%m-%d), $device, $(nproc) × $(sed -n 's/^model name[^:]*: //p' /proc/cpuinfo | head -1)" >"$out/report.md"

# Runs a part with a time limit, and adds the command, the end of its output and its duration to the report.
part() { # NAME SECONDS COMMAND…
    local name=$1 seconds=$2 began=$SECONDS status=0 pattern
    shift 2
    for pattern in "${patterns[@]}" ""; do
        # shellcheck disable=SC2053 # a pattern
        [[ $name != $pattern ]] || break
    done
    [ -n "$pattern" ] || return 0
    timeout -k 5 "$seconds" "$@" >"$out/$name.log" 2>&1 || status=$?
    [ $status -eq 0 ] || failed=$((failed + 1))
    {
        printf '\n## %s\n\n    %s\n\n```text\n' "$name" "$*"
        tail -n 60 "$out/$name.log"
        printf '```\n\nexit status %s, %s s\n' "$status" "$((SECONDS - began))"
    } >>"$out/report.md"
    echo "on_a_gpu: $name: exit status $status, $((SECONDS - began)) s" >&2
}

bench() { # NAME SECONDS ARGUMENTS…
    part "$1" "$2" "$globalsplat" bench "${@:3}"
}

part doctor 120 "$globalsplat" doctor
[ "$device" = cpu ] || part nvidia-smi 20 nvidia-smi
part parity 200 "$python" -m parity --device "$device" ${parity[@]+"${parity[@]}"}
bench raster 60 raster "${raster[@]}" --device "$device"
if [ "$device" != cpu ] && command -v compute-sanitizer >/dev/null; then
    for tool in memcheck racecheck synccheck; do
        part "$tool" 120 compute-sanitizer --tool "$tool" --error-exitcode 9 --kernel-name regex=gs_ \
            "$globalsplat" bench raster --gaussians 500 --cameras 2 --size 64x64 --repeats 1 --device "$device"
    done
fi
for precision in bf16 f32; do
    for count in "${views[@]}"; do
        bench "model_${count}_views_$precision" 60 model --views "$count" --precision "$precision" --repeats "$repeats" \
            --device "$device" ${model[@]+"${model[@]}"}
    done
    bench "train_$precision" 90 train --batch "$batch" --steps "$steps" --device "$device" --set "train.precision=\"$precision\"" \
        ${model[@]+"${model[@]}"}
done
bench train_tiny 60 train --config configs/tiny.toml --batch 2 --steps "$steps" --device "$device" ${model[@]+"${model[@]}"}
bench refine 60 refine --steps "$steps" --device "$device" ${refine[@]+"${refine[@]}"}
scene="$work/scene/000000.torch"
part refine_scene 20 "$globalsplat" synth --out "$work/scene" --scenes 1 --frames 12 --size 64
part refine_photos 60 "$globalsplat" refine --scene "$scene" --device "$device" --steps "$steps" --correct-poses --correct-exposures \
    --out "$work/photos.ply"
part refine_splat 60 "$globalsplat" refine --scene "$scene" --device "$device" --steps "$steps" --splat "$work/photos.ply" \
    --holdout every:4 --contact-sheet "$work/views.png" --out "$work/splat.ply"
part refine_weights 60 "$globalsplat" refine --scene "$scene" --device "$device" --steps "$steps" --init model --gaussians 20000 \
    --correct-exposures --out "$work/weights.ply"
bench raster_million 60 raster "${large[@]}" --device "$device"
if [ "$device" != cpu ] && command -v ncu >/dev/null; then
    part ncu 120 ncu --clock-control none --kernel-name 'regex:gs_.*' --launch-skip 20 --launch-count 20 --section SpeedOfLight \
        --section Occupancy --section LaunchStats "$globalsplat" bench raster --repeats 2 --device "$device"
fi
bench raster_cpu 60 raster "${raster[@]}"
for config in first_light tiny; do
    part "training_$config" 90 "$globalsplat" train --device "$device" --config "configs/$config.toml" \
        --set 'data.captures=["synth:seed=1,scenes=8,frames=32,size=96"]' --set 'data.validation=[]' --set train.validate_every=0 \
        "${train[@]}" --out "$work/$config"
done

echo "on_a_gpu: $out/report.md, $failed parts failed" >&2
[ "$failed" -eq 0 ]
