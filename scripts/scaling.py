#!/usr/bin/env python3
"""Estimates the time to train the paper's main model on 8, 64 and 512 GPUs.

    scripts/scaling.py                      uses the default values
    scripts/scaling.py --gradients 337.3 --hides 0.4 --scene 40 270

The estimate has three inputs. `torchrun … bench train` measures two of them: the bytes of gradients that a step
all-reduces, and the fraction of a step that can overlap with it. The third is the milliseconds that a GPU takes for a
scene, which follows from the number of operations and the achieved fraction of a GPU's peak; docs/gpu.md has an H200's
time without L_perc.
"""

import argparse
from dataclasses import dataclass

STEPS, BATCH = 220_000, 16
GPUS_IN_A_NODE = 8
# Latency of a message to the next GPU in seconds: within a node, and between nodes.
LATENCY = {"node": 5e-6, "network": 15e-6}


@dataclass
class Network:
    """An interconnect between nodes, with its bandwidth per node."""

    name: str
    bytes_per_second: float


# Bandwidth in bytes/s that NCCL achieves with fourth-generation NVLink, eight InfiniBand ports of 400 Gb/s, and one
# Ethernet port of 100 Gb/s.
NVLINK = 350e9
NETWORKS = [Network("8 × 400 Gb/s InfiniBand", 340e9), Network("100 Gb/s Ethernet", 11e9)]


def all_reduce(gradients: float, gpus: int, network: Network) -> float:
    """Returns the seconds of an all-reduce of `gradients` bytes over `gpus` GPUs.

    Bandwidth: a ring, in which each GPU sends and receives all bytes except its own share twice, limited by the slowest
    link. Latency: a tree, in which messages go up and down.
    """
    nodes = max(1, gpus // GPUS_IN_A_NODE)
    wire = NVLINK if nodes == 1 else min(NVLINK, network.bytes_per_second)
    depth = min(gpus, GPUS_IN_A_NODE).bit_length() * LATENCY["node"] + (nodes - 1).bit_length() * LATENCY["network"]
    return 2 * (gpus - 1) / gpus * gradients / wire + 2 * depth


def row(gpus: int, scene: float, gradients: float, hides: float, network: Network) -> str:
    """Returns a row of the table, for `scene` seconds per scene."""
    scenes = max(1, BATCH // gpus)
    computing, adding = scenes * scene, all_reduce(gradients, gpus, network)
    waiting = max(0.0, adding - hides * computing)
    steps = STEPS * BATCH / (gpus * scenes)
    hours = steps * (computing + waiting) / 3600
    efficiency = computing / (computing + waiting)
    return (
        f"| {gpus} | {network.name if gpus > GPUS_IN_A_NODE else 'NVLink'} | {gpus * scenes} | {1e3 * computing:.0f} | {1e3 * adding:.1f} "
        f"| {1e3 * waiting:.1f} | {efficiency:.0%} | {hours:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gradients", type=float, default=337.3, help="megabytes of gradients that a step all-reduces")
    parser.add_argument("--hides", type=float, default=0.4, help="fraction of a step that overlaps (encoder backward)")
    parser.add_argument("--scene", type=float, nargs="+", default=[40, 270], help="milliseconds per scene on a GPU")
    of = parser.parse_args()
    gradients = of.gradients * 1e6
    for milliseconds in of.scene:
        print(f"A scene in {milliseconds:.0f} ms, {BATCH * STEPS / 1e6:.2f} million scenes in all:\n")
        print("| GPUs | wires | scenes in a step | computing, ms | adding up, ms | waiting, ms | efficiency | hours |")
        print("|---|---|---|---|---|---|---|---|")
        for gpus in (8, 64, 512):
            for network in NETWORKS[: 1 if gpus <= GPUS_IN_A_NODE else None]:
                print(row(gpus, 1e-3 * milliseconds, gradients, of.hides, network))
        # Bandwidth below which GPUs wait, with one scene per GPU.
        needed = 2 * gradients / (of.hides * 1e-3 * milliseconds)
        print(f"\nBelow {needed / 1e9:.0f} GB/s a node, one scene for each GPU can't hide it.\n")


if __name__ == "__main__":
    main()
