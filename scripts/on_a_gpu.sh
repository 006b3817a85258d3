#!/usr/bin/env bash
# Runs the checks that need a GPU: parity of all operations, memory and speed compared with the CPU, and training. Parts run in order of
# importance. If one fails or the time runs out, the others are still reported.
#   scripts/on_a_gpu.sh              runs all parts on the first GPU
#   scripts/on_a_gpu.sh --dry-run    runs the same commands at a reduced size, as a smoke test of a minute or two; DEVICE=cpu without a GPU
#   scripts/on_a_gpu.sh --only 'model*'     runs the parts whose name matches the shell pattern (* and ?); may be repeated
#   DEVICE    cuda or cuda:N (default: cuda)
#   OUT       output folder; gets report.md, figures.json and logs.tar.gz, nothing else (default: runs/on_a_gpu)
#   SECONDS_IN_ALL  time limit of all parts together, in seconds (default: 580)
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

dry=false only=()
asked="$*"
while [ $# -gt 0 ]; do
    case "$1" in
    --dry-run) dry=true ;;
    --only) only+=("${2:?--only names parts}") && shift ;;
    *)
        echo "on_a_gpu: unknown argument $1, expected --dry-run or --only PART" >&2
        exit 2
        ;;
    esac
    shift
done

model=() large=(--gaussians 1000000 --cameras 1 --size 1920x1080 --repeats 20)
train=(--set train.steps=300)
if $dry; then
    parity=(--only 'projection_float32')
    raster=(--gaussians 500 --cameras 2 --size 64x64 --repeats 2)
    large=(--gaussians 2000 --cameras 1 --size 128x64 --repeats 2)
    views=(2) repeats=2
    model=(--set 'data.image_size=[32,32]' --set model.patch_size=16 --set model.latents=16 --set model.width=32)
    refine=(--gaussians 500 --size 64x64)
    batch=1 steps=2 train=(--set train.steps=2 --set curriculum.full_capacity=true)
else
    parity=()
    raster=(--repeats 100)
    views=(24 12 36) repeats=50
    refine=()
    batch=4 steps=10
fi

mkdir -p "$out"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
mkdir "$work/logs" "$work/figures"
report="$work/report.md"
failed=0
began=$(date +%s)
limit="${SECONDS_IN_ALL:-580}"

# Succeeds if the options select the part.
is_asked() { # NAME
    local pattern
    [ ${#only[@]} -gt 0 ] || return 0
    for pattern in "${only[@]}"; do
        # shellcheck disable=SC2053 # a pattern
        [[ $1 != $pattern ]] || return 0
    done
    return 1
}

# Writes the results so far to OUT, so that they are available if the script is interrupted.
hand_out() {
    cp "$report" "$out/report.md"
    tar -czf "$out/logs.tar.gz" -C "$work" logs
    "$python" - "$work/figures" "$out/figures.json" <<'PYTHON'
import json, pathlib, sys
folder, out = map(pathlib.Path, sys.argv[1:])
figures = {}
for file in sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime):
    try:
        figures[file.stem] = json.loads(file.read_text())
    except ValueError:
        pass  # A failed part wrote no figures.
out.write_text(json.dumps(figures, indent=1) + "\n")
PYTHON
}

# Runs a part with a time limit of SECONDS, and adds the command, the end of its output and its duration to the report.
part() { # NAME SECONDS COMMAND…
    local name=$1 seconds=$2 from left status log="$work/logs/$1.log" shown
    shift 2
    shown="$*"
    [ "$1" != bash ] || shown="${*:7}"
    is_asked "$name" || return 0
    from=$(date +%s)
    left=$((began + limit - from))
    if [ "$left" -lt 5 ]; then
        echo "## $name: skipped, out of time" >>"$report"
        return 0
    fi
    timeout -k 5 "$((seconds < left ? seconds : left))" "$@" >"$log" 2>&1
    status=$?
    {
        echo "## $name"
        echo
        echo "    ${shown//$work/WORK}"
        echo
        [ $status -eq 0 ] || echo "**FAILED**, exit status $status."
        echo '```text'
        tail -n 60 "$log"
        echo '```'
        echo "$(($(date +%s) - from)) s"
        echo
    } >>"$report"
    echo "on_a_gpu: $name: $([ $status -eq 0 ] && echo done || echo "FAILED, exit status $status"), $(($(date +%s) - from)) s" >&2
    [ $status -eq 0 ] || failed=$((failed + 1))
    hand_out
}

# Runs a benchmark as a part: saves its figures as JSON, and adds them to the report.
bench() { # NAME SECONDS ARGUMENTS…
    local name=$1 seconds=$2
    shift 2
    # shellcheck disable=SC2016 # expanded by the inner shell
    part "$name" "$seconds" bash -c 'figures=$1 python=$2; shift 2; "$@" --json >"$figures" && "$python" -m json.tool "$figures"' \
        bench "$work/figures/$name.json" "$python" "$globalsplat" bench "$@"
}

{
    echo "# On a GPU"
    echo
    echo "$(date -u +%Y-%m-%d), \`DEVICE=$device scripts/on_a_gpu.sh $asked\`, $(nproc) × $(sed -n 's/^model name[^:]*: //p' /proc/cpuinfo | head -1)"
    echo
} >"$report"

part doctor 120 "$globalsplat" doctor
[ "$device" = cpu ] || part nvidia-smi 20 nvidia-smi
part parity 200 "$python" -m parity --device "$device" ${parity[@]+"${parity[@]}"}
bench raster 60 raster "${raster[@]}" --device "$device"
if [ "$device" != cpu ] && command -v compute-sanitizer >"$work/found"; then
    for tool in memcheck racecheck synccheck; do
        part "$tool" 120 compute-sanitizer --tool "$tool" --error-exitcode 9 --kernel-name regex=gs_ \
            "$globalsplat" bench raster --gaussians 500 --cameras 2 --size 64x64 --repeats 1 --device "$device"
    done
fi
for count in "${views[@]}"; do
    for precision in bf16 f32; do
        bench "model_${count}_views_$precision" 60 model --views "$count" --precision "$precision" --repeats "$repeats" \
            --device "$device" ${model[@]+"${model[@]}"}
    done
done
for precision in bf16 f32; do
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
if [ "$device" != cpu ] && command -v ncu >"$work/found"; then
    part ncu 120 ncu --clock-control none --kernel-name 'regex:gs_.*' --launch-skip 20 --launch-count 20 --section SpeedOfLight \
        --section Occupancy --section LaunchStats "$globalsplat" bench raster --repeats 2 --device "$device"
fi
bench raster_cpu 60 raster "${raster[@]}"
for config in first_light tiny; do
    part "training_$config" 90 "$globalsplat" train --device "$device" --config "configs/$config.toml" \
        --set 'data.captures=["synth:seed=1,scenes=8,frames=32,size=96"]' --set 'data.validation=[]' --set train.validate_every=0 \
        "${train[@]}" --out "$work/$config"
done

echo "$(($(date +%s) - began)) s in all, $failed parts failed." >>"$report"
hand_out
echo "on_a_gpu: $out/report.md, $failed parts failed" >&2
[ "$failed" -eq 0 ]
