#!/usr/bin/env python3
"""What training the paper's main model would take on 8, 64 and 512 GPUs, on paper.

    scripts/scaling.py                      with the numbers below
    scripts/scaling.py --gradients 337.3 --hides 0.4 --scene 40 270

From three parts: how many bytes of gradients a step adds up, in which share of a step that can be hidden, both measured by
`torchrun … bench train`, and the milliseconds that a GPU takes for a scene. The last follows from a count of operations and a share of
a GPU's peak; docs/gpu.md has what an H200 takes without L_perc.
"""

import argparse
from dataclasses import dataclass

STEPS, BATCH = 220_000, 16
GPUS_IN_A_NODE = 8
# Seconds that a message takes to the next GPU: in a node, and between nodes.
LATENCY = {"node": 5e-6, "network": 15e-6}


@dataclass
class Network:
    """What leaves a node."""

    name: str
    bytes_per_second: float


# What NCCL makes of NVLink's fourth generation, of eight InfiniBand ports of 400 Gb/s, and of one Ethernet port of 100 Gb/s.
NVLINK = 350e9
NETWORKS = [Network("8 × 400 Gb/s InfiniBand", 340e9), Network("100 Gb/s Ethernet", 11e9)]


def all_reduce(gradients: float, gpus: int, network: Network) -> float:
    """Seconds in which `gpus` GPUs add their `gradients` bytes up: in rings, of which each GPU sends and receives all bytes but its own
    share, twice; the slowest wire decides. Messages go up and down a tree."""
    nodes = max(1, gpus // GPUS_IN_A_NODE)
    wire = NVLINK if nodes == 1 else min(NVLINK, network.bytes_per_second)
    depth = min(gpus, GPUS_IN_A_NODE).bit_length() * LATENCY["node"] + (nodes - 1).bit_length() * LATENCY["network"]
    return 2 * (gpus - 1) / gpus * gradients / wire + 2 * depth


def row(gpus: int, scene: float, gradients: float, hides: float, network: Network) -> str:
    """A line of the table: `scene` seconds for each scene of a step."""
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
    parser.add_argument("--gradients", type=float, default=337.3, help="megabytes that a step adds up")
    parser.add_argument("--hides", type=float, default=0.4, help="share of a step in which they can leave: the encoder's backward pass")
    parser.add_argument("--scene", type=float, nargs="+", default=[40, 270], help="milliseconds that a GPU takes for a scene")
    of = parser.parse_args()
    gradients = of.gradients * 1e6
    for milliseconds in of.scene:
        print(f"A scene in {milliseconds:.0f} ms, {BATCH * STEPS / 1e6:.2f} million scenes in all:\n")
        print("| GPUs | wires | scenes in a step | computing, ms | adding up, ms | waiting, ms | efficiency | hours |")
        print("|---|---|---|---|---|---|---|---|")
        for gpus in (8, 64, 512):
            for network in NETWORKS[: 1 if gpus <= GPUS_IN_A_NODE else None]:
                print(row(gpus, 1e-3 * milliseconds, gradients, of.hides, network))
        # Where waiting begins, for one scene a GPU.
        needed = 2 * gradients / (of.hides * 1e-3 * milliseconds)
        print(f"\nBelow {needed / 1e9:.0f} GB/s a node, one scene for each GPU can't hide it.\n")


if __name__ == "__main__":
    main()
