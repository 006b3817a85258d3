#!/usr/bin/env bash
# What only a machine with a GPU can tell, in one call of less than ten minutes: parity of everything on it, what it takes and how
# fast it is beside the CPU, training and the demo. Goes on where a part fails, and writes one report, OUT/report.md:
#   scripts/on_a_gpu.sh              on the first GPU
#   DEVICE=cpu scripts/on_a_gpu.sh --dry-run    the same commands in small, to see that they work
#   DEVICE    cuda or cuda:N (default: cuda)
#   OUT       where everything goes (default: runs/on_a_gpu)
#   LIBTORCH  the libtorch to run with, where the program was built with another one's path
#   PYTHON    with torch, for parity (default: .venv/bin/python)
# Fails if a part did.
set -uo pipefail
cd "$(dirname "$0")/.."
device="${DEVICE:-cuda}"
out="${OUT:-runs/on_a_gpu}"
python="${PYTHON:-.venv/bin/python}"
globalsplat=target/release/globalsplat
[ -z "${LIBTORCH:-}" ] || export LD_LIBRARY_PATH="$LIBTORCH/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"

if [ "${1:-}" = --dry-run ]; then
    parity=(--only 'projection_float32')
    raster=(--gaussians 500 --cameras 2 --size 64x64 --repeats 2)
    views=(2)
    small=(--set 'data.image_size=[32,32]' --set model.patch_size=16 --set model.latents=16 --set model.width=32)
    batch=1 steps=2 train=(--set train.steps=2 --set curriculum.full_capacity=true)
    demo=()
else
    parity=()
    raster=(--repeats 100)
    views=(12 24 36)
    small=()
    batch=16 steps=10 train=(--set train.steps=300)
    demo=(env DEVICE="$device" CAPTURES=none OUT="$out/demo" scripts/demo.sh)
fi

# Runs of an earlier report would be gone on with.
rm -rf "$out/first_light" "$out/tiny" "$out/demo"
mkdir -p "$out"
report="$out/report.md"
failed=0
began=$(date +%s)
limit=580 # seconds, of all parts together

# A part of the report: what a command says, within so many seconds.
part() { # TITLE SECONDS COMMAND…
    local title=$1 seconds=$2 from left status
    shift 2
    from=$(date +%s)
    left=$((began + limit - from))
    timeout "$((seconds < left ? seconds : left > 1 ? left : 1))" "$@" >"$out/part.log" 2>&1
    status=$?
    {
        echo "## $title"
        echo
        echo "    $*"
        echo
        [ $status -eq 0 ] || echo "**FAILED**, exit status $status."
        echo '```text'
        tail -n 60 "$out/part.log"
        echo '```'
        echo "$(($(date +%s) - from)) s"
        echo
    } >>"$report"
    echo "on_a_gpu: $title: $([ $status -eq 0 ] && echo done || echo FAILED), $(($(date +%s) - from)) s" >&2
    [ $status -eq 0 ] || failed=$((failed + 1))
}

{
    echo "# On a GPU"
    echo
    echo "$(date -u +%Y-%m-%d), \`DEVICE=$device scripts/on_a_gpu.sh $*\`, $(nproc) × $(sed -n 's/^model name[^:]*: //p' /proc/cpuinfo | head -1)"
    echo
} >"$report"

part "What is there" 120 "$globalsplat" doctor
[ "$device" = cpu ] || part "The GPU, by its own tool" 20 nvidia-smi
part "Parity" 150 "$python" parity/run.py --device "$device" ${parity[@]+"${parity[@]}"}
part "Splat op, CPU" 60 "$globalsplat" bench raster "${raster[@]}"
part "Splat op" 60 "$globalsplat" bench raster "${raster[@]}" --device "$device"
for count in "${views[@]}"; do
    for precision in bf16 f32; do
        part "The main model, $count views, $precision" 60 \
            "$globalsplat" bench model --views "$count" --precision "$precision" --device "$device" ${small[@]+"${small[@]}"}
    done
done
for precision in bf16 f32; do
    part "A training step of the main model, $precision" 90 \
        "$globalsplat" bench train --batch "$batch" --steps "$steps" --device "$device" --set "train.precision=\"$precision\"" \
        ${small[@]+"${small[@]}"}
done
for config in first_light tiny; do
    part "Training, configs/$config.toml" 90 "$globalsplat" train --device "$device" --config "configs/$config.toml" \
        --set 'data.captures=["synth:seed=1,scenes=8,frames=32,size=96"]' --set 'data.validation=[]' --set train.validate_every=0 \
        "${train[@]}" --out "$out/$config"
done
[ ${#demo[@]} -eq 0 ] || part "The demo" 240 "${demo[@]}"

echo "$(($(date +%s) - began)) s in all, $failed parts failed." >>"$report"
echo "on_a_gpu: $report, $failed parts failed" >&2
[ "$failed" -eq 0 ]
