#!/usr/bin/env bash
# Trains on several nodes under Slurm, as one run:
#   sbatch scripts/slurm_train.sh configs/re10k_16k.toml runs/re10k [any other option of `globalsplat train`]
# from the folder of the checkout, which all nodes see, after `make build`. Slurm's own options go before the script's name, as in
# `sbatch --nodes=2 scripts/slurm_train.sh …`. The same command goes on where a job ended, whatever the number of nodes.
#   PROCESSES  on each node (default: as many as it has GPUs)
#   DEVICE     cuda or cpu (default: cuda)
#   TORCHRUN   by which they are started (default: .venv/bin/torchrun)
#SBATCH --job-name=globalsplat
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --gpus-per-node=8
#SBATCH --exclusive
#SBATCH --time=24:00:00
#SBATCH --signal=TERM@120
#SBATCH --open-mode=append
#SBATCH --output=globalsplat-%j.log
set -euo pipefail
if [ $# -lt 2 ]; then
    echo "usage: sbatch $0 CONFIG RUN [option of globalsplat train]…" >&2
    exit 2
fi
config=$1 run=$2
shift 2
# Slurm runs a copy of this file, in the folder from which it was submitted.
cd "${SLURM_SUBMIT_DIR:-$PWD}"

# All processes meet at the first node. Jobs that share it are kept apart by their numbers.
first=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
port=$((20000 + SLURM_JOB_ID % 20000))

# Two minutes before its time is over, Slurm sends TERM: the run saves a checkpoint and ends. A process that dies otherwise is started
# again with all others, which meet anew, at a port of their own, and go on from the last checkpoint.
export TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1
exec srun "${TORCHRUN:-.venv/bin/torchrun}" \
    --nnodes="$SLURM_NNODES" --nproc-per-node="${PROCESSES:-${SLURM_GPUS_ON_NODE:-8}}" \
    --rdzv-backend=c10d --rdzv-endpoint="$first:$port" --rdzv-id="$SLURM_JOB_ID" --max-restarts=3 \
    --no-python target/release/globalsplat train --config "$config" --out "$run" --device "${DEVICE:-cuda}" "$@"
