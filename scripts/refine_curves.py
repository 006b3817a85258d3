#!/usr/bin/env python3
"""Plots the PSNR of held-out views over time in `globalsplat refine`, from photos alone and from the shipped weights.

    .venv/bin/python scripts/refine_curves.py --capture DIR HOLDOUT [VIEWS] [--capture …] [--out OUT] [--seconds 60]

Photos are cropped and resized to 256×256. Writes OUT/curves.svg and prints a Markdown table. Run nothing else
meanwhile. Completed runs are not repeated.
"""

import argparse
from pathlib import Path

from core_runs import row
from refine_runs import SMALL, refined

STARTS = {"nothing": "photos alone", "weights": "the shipped weights"}
SECONDS = [2, 3, 5, 10, 20, 30, 60]
WIDTH, HEIGHT, LEFT, TOP = 250, 190, 34, 26  # size and margins of one capture's plot, in pixels


def curve(out, capture, start, seconds):
    """Returns [(seconds, PSNR)] of held-out views; the first entry is that of the initial splat."""
    folder, holdout, *views = capture
    more = ["--from", start, *(["--views", views[0]] if views else [])]
    told = refined(out / f"{Path(folder).name}.{start}.json", folder, holdout, seconds, *SMALL, *more)
    return [(mark["seconds"], mark["psnr"]) for mark in told["held_out"]["curve"]]


def at(marks, seconds):
    """Returns the last PSNR measured by `seconds`, formatted, or an empty string."""
    reached = [psnr for second, psnr in marks if second <= seconds + 0.05]
    return f"{reached[-1]:.1f}" if reached else ""


def plot(name, curves, seconds, left):
    """Returns one capture's curves as SVG."""
    values = [psnr for marks in curves.values() for _, psnr in marks]
    low, high = int(min(values)), int(max(values)) + 1
    x = lambda second: left + LEFT + second / seconds * (WIDTH - LEFT - 12)
    y = lambda psnr: TOP + (high - psnr) / (high - low) * (HEIGHT - TOP - 34)
    parts = [f'<text x="{left + LEFT}" y="16" class="name">{name}</text>']
    for psnr in range(low, high + 1, max(1, (high - low) // 4)):
        parts.append(f'<path class="grid" d="M{x(0):.1f} {y(psnr):.1f}H{x(seconds):.1f}"/>')
        parts.append(f'<text x="{left + LEFT - 6}" y="{y(psnr) + 4:.1f}" text-anchor="end">{psnr}</text>')
    for second in range(0, int(seconds) + 1, 20):
        parts.append(f'<text x="{x(second):.1f}" y="{HEIGHT - 16}" text-anchor="middle">{second} s</text>')
    for start, marks in curves.items():
        points = " ".join(f"{x(second):.1f},{y(psnr):.1f}" for second, psnr in marks)
        parts.append(f'<polyline class="{start}" points="{points}"><title>{STARTS[start]}</title></polyline>')
    return "".join(parts)


STYLE = """text { font: 12px system-ui, sans-serif; fill: #59636e } .name { font-weight: 600 } .grid { stroke: #8c959f55 }
polyline { fill: none; stroke-width: 2 } .nothing { stroke: #2f6fd0 } .weights { stroke: #d07a2f }"""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", nargs="+", action="append", required=True, metavar="DIR HOLDOUT VIEWS")
    parser.add_argument("--out", type=Path, default=Path("runs/refine"))
    parser.add_argument("--seconds", type=float, default=60)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    row("capture", "begins with", *(f"{second} s" for second in SECONDS))
    row(*["---"] * (2 + len(SECONDS)))
    plots = []
    for index, capture in enumerate(arguments.capture):
        curves = {start: curve(arguments.out, capture, start, arguments.seconds) for start in STARTS}
        name = Path(capture[0]).name
        for start, marks in curves.items():
            row(name, STARTS[start], *(at(marks, second) for second in SECONDS))
        plots.append(plot(name, curves, arguments.seconds, index * WIDTH))
    width = WIDTH * len(plots)
    legend = "".join(
        f'<path d="M{LEFT + 150 * i} {HEIGHT + 4}h22" class="{start}" style="stroke-width: 2"/>'
        f'<text x="{LEFT + 28 + 150 * i}" y="{HEIGHT + 8}">{STARTS[start]}</text>'
        for i, start in enumerate(STARTS)
    )
    size = f'viewBox="0 0 {width} {HEIGHT + 16}" width="{width}" height="{HEIGHT + 16}"'
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" {size}><style>{STYLE}</style>{"".join(plots)}{legend}</svg>\n'
    (arguments.out / "curves.svg").write_text(svg)


if __name__ == "__main__":
    main()
