"""Line plots of PSNR over time as SVG, one plot per capture, for scripts that measure `globalsplat refine`."""

import math
from itertools import cycle

WIDTH, HEIGHT, LEFT, TOP = 250, 190, 34, 26  # size and margins of one plot, in pixels
COLOURS = ["#2f6fd0", "#d07a2f", "#3a9a5b", "#a04fb8", "#8c6d1f"]
STYLE = """text { font: 12px system-ui, sans-serif; fill: #59636e } .name { font-weight: 600 } .grid { stroke: #8c959f55 }
polyline { fill: none; stroke-width: 2 }"""


def plot(name, curves, colours, ticks, is_logarithmic, left):
    """Returns the curves of one capture, lists of (seconds, PSNR) by label, as SVG. `colours` are those of the labels."""
    values = [psnr for points in curves.values() for _, psnr in points]
    low, high = math.floor(min(values)), math.floor(max(values)) + 1
    scale = math.log if is_logarithmic else float
    begin, end = scale(ticks[0]), scale(ticks[-1])

    def x(second):
        return left + LEFT + (scale(max(second, ticks[0])) - begin) / (end - begin) * (WIDTH - LEFT - 18)

    def y(psnr):
        return TOP + (high - psnr) / (high - low) * (HEIGHT - TOP - 34)

    parts = [f'<text x="{left + LEFT}" y="16" class="name">{name}</text>']
    for psnr in range(low, high + 1, max(1, (high - low) // 4)):
        parts.append(f'<path class="grid" d="M{x(ticks[0]):.1f} {y(psnr):.1f}H{x(ticks[-1]):.1f}"/>')
        parts.append(f'<text x="{left + LEFT - 6}" y="{y(psnr) + 4:.1f}" text-anchor="end">{psnr}</text>')
    for second in ticks:
        parts.append(f'<text x="{x(second):.1f}" y="{HEIGHT - 16}" text-anchor="middle">{second:g} s</text>')
    for label, points in curves.items():
        line = " ".join(f"{x(second):.1f},{y(psnr):.1f}" for second, psnr in points)
        parts.append(f'<polyline stroke="{colours[label]}" points="{line}"><title>{label}</title></polyline>')
    return "".join(parts)


def line_plots(captures, ticks, is_logarithmic=False):
    """Returns plots side by side as an SVG. `captures` has for each name its curves, see `plot`; `ticks` are seconds."""
    labels = dict.fromkeys(label for curves in captures.values() for label in curves)
    colours = dict(zip(labels, cycle(COLOURS), strict=False))
    plots = [
        plot(name, curves, colours, ticks, is_logarithmic, i * WIDTH)
        for i, (name, curves) in enumerate(captures.items())
    ]
    legend = "".join(
        f'<path d="M{LEFT + 150 * i} {HEIGHT + 4}h22" style="stroke: {colour}; stroke-width: 2"/>'
        f'<text x="{LEFT + 28 + 150 * i}" y="{HEIGHT + 8}">{label}</text>'
        for i, (label, colour) in enumerate(colours.items())
    )
    width = max(WIDTH * len(plots), LEFT + 150 * len(colours))
    size = f'viewBox="0 0 {width} {HEIGHT + 16}" width="{width}" height="{HEIGHT + 16}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}><style>{STYLE}</style>{"".join(plots)}{legend}</svg>\n'
