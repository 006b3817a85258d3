#!/usr/bin/env bash
# Trains one run on several nodes under Slurm:
#   sbatch scripts/slurm_train.sh configs/re10k_16k.toml runs/re10k [any other option of `globalsplat train`]
# Run it after `make build`, from the folder of the checkout, which must be on a file system that all nodes share. Slurm's own options
# go before the script's name, as in `sbatch --nodes=2 scripts/slurm_train.sh …`. The same command resumes where a job ended, with any
# number of nodes.
#   PROCESSES  processes per node (default: the node's number of GPUs)
#   DEVICE     cuda or cpu (default: cuda)
#   TORCHRUN   the torchrun that starts the processes (default: .venv/bin/torchrun)
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
# Slurm runs a copy of this file, in the folder from which the job was submitted.
cd "${SLURM_SUBMIT_DIR:-$PWD}"

# The rendezvous is on the first node. Jobs that share this node use different ports, derived from the job ID.
first=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
port=$((20000 + SLURM_JOB_ID % 20000))

# Two minutes before the time limit, Slurm sends TERM: the run saves a checkpoint and ends. If a process dies for another reason,
# torchrun restarts all processes, which rendezvous again at a new port and resume from the last checkpoint.
export TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1
exec srun "${TORCHRUN:-.venv/bin/torchrun}" \
    --nnodes="$SLURM_NNODES" --nproc-per-node="${PROCESSES:-${SLURM_GPUS_ON_NODE:-8}}" \
    --rdzv-backend=c10d --rdzv-endpoint="$first:$port" --rdzv-id="$SLURM_JOB_ID" --max-restarts=3 \
    --no-python target/release/globalsplat train --config "$config" --out "$run" --device "${DEVICE:-cuda}" "$@"
