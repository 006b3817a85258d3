"""Generation of docs/parity.md, the report of the comparison for readers who don't run it.

The document is reproducible from the results, so it has no times, dates or paths; the only trace of the machine is its
processor's name.
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
    "absolute": "the largest absolute difference, divided by the largest value if that is below 1",
    "zero": "the norm of what is zero in exact arithmetic, as a share of the case's largest gradient",
    "exact": "whole numbers, which have to be equal",
}


def find_processor_name():
    """Returns the model name of this machine's CPU."""
    information = Path("/proc/cpuinfo")
    for line in information.read_text().splitlines() if information.exists() else ():
        if line.startswith("model name") and ":" in line:
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def format_document(results, command, device):
    """Returns the Markdown document. `command` is the command line that writes it."""
    sections = [
        ["# Verification", *describe_run(results, command, device)],
        ["## Cases", *format_cases(results)],
        ["## Case-specific tolerances", format_list(list_tolerance_reasons(results))],
        ["## Excluded pixels", format_list(doubtful(results))],
        ["## Threshold decisions that differ", format_list(flipped(results))],
        ["## Failures", format_list(failures(results))],
        ["## Self-test", *describe_self_test(results)],
    ]
    return "\n\n".join(part for section in sections if any(section[1:]) for part in section if part) + "\n"


def describe_run(results, command, device):
    names = list(by_case(results))
    large = list(dict.fromkeys(f"`{result.case}`" for result in results if result.large))
    precision = f"float64 ({', '.join(large)} in float32, for its size)" if large else "float64"
    failed = sum(not result.passed for result in results)
    where = find_processor_name() + ("" if device == "cpu" else f" with {device}")
    yield wrap(
        "Weights and inputs are drawn at random. The program computes outputs and gradients with the same code as "
        f"training; `parity/reference/`, the same maths in plain torch, computes them in {precision}. A tensor passes "
        "when its relative L2 error, `|ours - reference| / |reference|`, is within its tolerance: "
        f"{FLOAT32.outputs:.0e} for outputs and {FLOAT32.gradients:.0e} for gradients where the program computes in "
        f"float32, {FLOAT64.outputs:.0e} and {FLOAT64.gradients:.0e} where it does in float64, unless the case says "
        "why it needs another. Cases are in `parity/harness/areas/`."
    )
    yield wrap(
        f"{format_count(len(results), 'draw')} of {format_count(len(names), 'case')}, {failed or 'none'} failed, on "
        f"{where}. Another processor may round differently, so that errors differ in their last digits. This page was "
        "written by:"
    )
    yield f"    {command}"


def format_cases(results):
    """Yields the table of cases: the worst errors of outputs and of gradients, with their tolerances."""
    lines, measures = ["| case | draws | outputs | gradients |", "|---|---|---|---|"], set()
    for case, found in by_case(results).items():
        cells = []
        for is_kind in (is_output, is_gradient):
            findings = [finding for result in found for finding in result.findings if is_kind(finding)]
            worst = max(findings, key=lambda finding: finding.share, default=None)
            cells.append("" if worst is None else format_cell(worst))
            measures |= set() if worst is None else {worst.measure}
        lines.append(f"| {case} | {len(found)} | {' | '.join(cells)} |")
    yield wrap("Each cell is the largest error over the draws of a case, and its tolerance.")
    yield "\n".join(lines)
    yield format_list(f"{measure}: {meaning}" for measure, meaning in MEASURES.items() if measure in measures)


def format_cell(finding):
    if finding.problem:
        return f"**{finding.problem}**"
    if finding.measure == "exact":
        return "exact" if finding.passed else "**wrong**"
    unit = "" if finding.measure == "relative" else f" {finding.measure}"
    text = f"{finding.error:.0e} of {finding.tolerance:.0e}{unit}"
    return text if finding.passed else f"**{text}**"


def list_tolerance_reasons(results):
    """Returns a line for each reason why cases have their own tolerances."""
    cases_of = {}
    for result in results:
        if result.tolerance.why:
            cases_of.setdefault(result.tolerance.why, {})[f"`{result.case}`"] = True
    return [f"{', '.join(names)}: {why}" for why, names in cases_of.items()]


def describe_self_test(results):
    tried = sum(result.tried for result in results)
    missed = list_undetected(results)
    if not tried:
        return
    outcome = f"{len(missed):,} were accepted:" if missed else "all were rejected."
    yield wrap(
        "The self-test perturbs every result that passes, one tensor at a time, and checks that the comparison rejects "
        f"it: the tensor is missing, is NaN, is multiplied by {FACTOR:g}, has one slice along an axis set to zero, has "
        "two axes swapped, is incremented by one (integers), or is nonzero where zero is expected. Where the tolerance "
        f"is wide, the change is at least {MIN_CHANGE_IN_TOLERANCES:g} times the tolerance. Of {tried:,} perturbed "
        f"results, {outcome}"
    )
    yield format_list(missed)


def format_count(number, noun):
    return f"{number:,} {noun}" + ("" if number == 1 else "s")


def wrap(text):
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def format_list(texts):
    return "\n".join(
        textwrap.fill(
            text, WIDTH, initial_indent="- ", subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
        )
        for text in texts
    )
