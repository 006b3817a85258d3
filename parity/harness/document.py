"""Generation of docs/parity.md, the report of the comparison for readers who don't run it.

The document is reproducible from the results, so it has no times, dates or paths of a machine.
"""

import platform
import textwrap
from pathlib import Path

from .perturb import FACTOR, MIN_CHANGE_IN_TOLERANCES
from .table import by_case, doubtful, failures, flipped, is_gradient, is_output, list_undetected
from .tolerance import FLOAT32, FLOAT64

WIDTH = 120
# Descriptions of the error measures other than the relative error.
MEASURES = {
    "absolute": "the largest difference of a value, as a share of the largest value where that is below 1",
    "zero": "the norm of what is zero in exact arithmetic, as a share of the case's largest gradient",
    "exact": "whole numbers, which have to be equal",
}


def processor():
    """Returns the name of the processor, as the program's own reports have it."""
    information = Path("/proc/cpuinfo")
    for line in information.read_text().splitlines() if information.exists() else ():
        if line.startswith("model name") and ":" in line:
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def document(results, command, device):
    """Returns the Markdown document. `command` is the command line that writes it."""
    sections = [
        ["# Verification", *about(results, command, device)],
        ["## Cases", *cases(results)],
        ["## Case-specific tolerances", bullets(whys(results))],
        ["## Pixels left out", bullets(doubtful(results))],
        ["## Close calls decided otherwise", bullets(flipped(results))],
        ["## Failures", bullets(failures(results))],
        ["## Self-test", *self_test(results)],
    ]
    return "\n\n".join(part for section in sections if any(section[1:]) for part in section if part) + "\n"


def about(results, command, device):
    names = list(by_case(results))
    large = list(dict.fromkeys(f"`{result.case}`" for result in results if result.large))
    precision = f"float64 ({', '.join(large)} in float32, for its size)" if large else "float64"
    failed = sum(not result.passed for result in results)
    where = processor() if device == "cpu" else f"{processor()} with {device}"
    yield prose(
        "Weights and inputs are drawn at random. The program computes outputs and gradients by the code that training "
        f"runs; `parity/reference/`, the same maths in plain torch, computes them in {precision}. A tensor passes when "
        "its relative L2 error, `|ours - reference| / |reference|`, is within its tolerance: "
        f"{FLOAT32.outputs:.0e} for outputs and {FLOAT32.gradients:.0e} for gradients where the program computes in "
        f"float32, {FLOAT64.outputs:.0e} and {FLOAT64.gradients:.0e} where it does in float64, unless the case says "
        "why it needs another. Cases are in `parity/harness/areas/`."
    )
    yield prose(
        f"{count(len(results), 'draw')} of {count(len(names), 'case')}, {failed or 'none'} failed, on {where}. "
        "Another processor may round otherwise, so that errors differ in their last digits. Written by"
    )
    yield f"    {command}"


def cases(results):
    """Yields the table of cases: the worst errors of outputs and of gradients, with their tolerances."""
    lines, measures = ["| case | draws | outputs | gradients |", "|---|---|---|---|"], set()
    for case, found in by_case(results).items():
        cells = []
        for is_kind in (is_output, is_gradient):
            findings = [finding for result in found for finding in result.findings if is_kind(finding)]
            worst = max(findings, key=lambda finding: finding.share, default=None)
            cells.append("" if worst is None else cell(worst))
            measures |= set() if worst is None else {worst.measure}
        lines.append(f"| {case} | {len(found)} | {' | '.join(cells)} |")
    yield prose("The worst error over the draws of each case, of what is allowed.")
    yield "\n".join(lines)
    yield bullets(f"{measure}: {meaning}" for measure, meaning in MEASURES.items() if measure in measures)


def cell(finding):
    if finding.problem:
        return f"**{finding.problem}**"
    if finding.measure == "exact":
        return "exact" if finding.passed else "**wrong**"
    unit = "" if finding.measure == "relative" else f" {finding.measure}"
    text = f"{finding.error:.0e} of {finding.tolerance:.0e}{unit}"
    return text if finding.passed else f"**{text}**"


def whys(results):
    """Returns the reasons of cases that have their own tolerances."""
    cases_of = {}
    for result in results:
        if result.tolerance.why:
            cases_of.setdefault(result.tolerance.why, {})[f"`{result.case}`"] = True
    return [f"{', '.join(names)}: {why}" for why, names in cases_of.items()]


def self_test(results):
    tried = sum(result.tried for result in results)
    missed = list_undetected(results)
    if not tried:
        return
    noticed = f"{len(missed):,} were not noticed:" if missed else "every one was noticed."
    yield prose(
        "The self-test takes every answer that passes and makes it wrong, one tensor at a time: left out, made NaN, "
        f"multiplied by {FACTOR:g}, without a slice along each axis, with two axes swapped, one more where it is a "
        f"whole number, not zero where it should be. Where a tolerance is wide, mistakes are "
        f"{MIN_CHANGE_IN_TOLERANCES:g} times it. Of {tried:,} wrong answers {noticed}"
    )
    yield bullets(missed)


def count(number, noun):
    return f"{number:,} {noun}" + ("" if number == 1 else "s")


def prose(text):
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def bullets(texts):
    return "\n".join(
        textwrap.fill(
            text, WIDTH, initial_indent="- ", subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
        )
        for text in texts
    )
