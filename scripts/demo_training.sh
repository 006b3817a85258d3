#!/usr/bin/env bash
# Fine-tunes the shipped weights on four synthetic scenes for some minutes, and compares both weights on them in one report.
#   scripts/demo_training.sh [--dry-run]    --dry-run: the same commands at a reduced size, as a smoke test
#   OUT       output folder (default: runs/demo_training). A run in it is continued
set -euo pipefail
cd "$(dirname "$0")/.."
globalsplat="target/release/globalsplat"
made=(--scenes 4 --frames 32 --size 192) settings=()
if [ "${1:-}" = --dry-run ]; then
    made=(--scenes 1 --frames 9 --size 32)
    settings=(--set train.steps=2 --set train.validate_every=1 --set data.context_views=2 --set data.min_context_views=2)
fi
out="${OUT:-runs/demo_training}"
captures="$out/synthetic"
[ -e "$captures" ] || "$globalsplat" synth --out "$captures" --seed 7 "${made[@]}"
"$globalsplat" train --config configs/fine_tune.toml --from models/tiny.safetensors --set "data.captures=[\"$captures\"]" \
    ${settings[@]+"${settings[@]}"} --out "$out/training"
"$globalsplat" export --run "$out/training" --out "$out/model.safetensors"
for weights in models/tiny.safetensors "$out/model.safetensors"; do
    name="$(basename "$weights" .safetensors)"
    "$globalsplat" eval --weights "$weights" --data "$captures" --index "$captures/evaluation_index.json" --name "$name" --out "$out/evaluation/$name"
done
"$globalsplat" report "$out/evaluation/tiny" "$out/evaluation/model" --out "$out/evaluation/report.html"
echo "LOOK: $out/evaluation/report.html compares scores, views and depths, before and after; TensorBoard shows $out/training"
