"""Prints the JSON output of a benchmark as tables.

    globalsplat bench model --json >model.json
    python scripts/show_figures.py model.json

A row is a part of the benchmark, with the median, the minimum and the upper quartile of its time.
"""

import json
import sys
from pathlib import Path

SPREAD = ("median", "least", "upper_quartile")


def is_spread(value):
    return isinstance(value, dict) and set(value) == set(SPREAD)


def show(figures):
    plain = {
        name: value for name, value in figures.items() if value is not None and not isinstance(value, (dict, list))
    }
    print(
        ", ".join(
            f"{name} {value:.5g}" if isinstance(value, float) else f"{name} {value}" for name, value in plain.items()
        )
    )
    spreads = {name: value for name, value in figures.items() if is_spread(value)}
    rows = [(name, value, {}) for name, value in spreads.items()]
    means = []
    for part in (part for group in ("stages", "sections", "parts") for part in figures.get(group, [])):
        if isinstance(part, list):
            means.append(part)
            continue
        rest = {name: value for name, value in part.items() if name not in ("name", "milliseconds")}
        rows.append((part["name"], part["milliseconds"], rest))
    print(f"{'ms':<24} " + " ".join(f"{name:>14}" for name in SPREAD))
    for name, spread, rest in rows:
        beside = "  ".join(f"{what} {value:.4g}" for what, value in rest.items())
        print(f"{name:<24} " + " ".join(f"{spread[at]:>14.4f}" for at in SPREAD) + f"  {beside}".rstrip())
    for name, mean in means:
        print(f"{name:<24} {mean:>14.4f} in the mean")
    for row in figures.get("against_cpu", []):
        other = f"{row['other_bits']} of {row['numbers']} numbers have other bits than the CPU's"
        print(f"{row['tensor']:<24} {other}, relative difference {row['relative_difference']:.1e}")


if __name__ == "__main__":
    show(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
