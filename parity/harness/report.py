"""Report of the results on the terminal."""

from .compare import is_gradient
from .registry import CASES

MAX_FAILURES = 5  # maximum number of failures shown per draw
HEADER = ("case", "draws", "of", "worst tensor", "max abs", "rel L2", "tolerance", "verdict")


def table(results):
    """Returns a table of the worst tensor of each case, of outputs and of gradients, followed by notes and failures."""
    rows, notes = [HEADER], []
    for case in dict.fromkeys(result.case for result in results):
        of_case = [result for result in results if result.case == case]
        for kind, of_gradients in (("outputs", False), ("gradients", True)):
            found = [f for result in of_case for f in result.findings if is_gradient(f.tensor) == of_gradients]
            if found:
                worst = max(found, key=lambda finding: finding.share)
                relative = "" if worst.relative is None else f"{worst.relative:.1e}"
                tolerance = "exact" if worst.measure == "exact" else f"{worst.tolerance:.0e} {worst.measure}"
                verdict = "ok" if all(finding.passed for finding in found) else "FAIL"
                tensor = worst.tensor.split(".", 1)[-1]
                rows.append(
                    (case, str(len(of_case)), kind, tensor, f"{worst.largest:.1e}", relative, tolerance, verdict)
                )
        if CASES[case].tolerance.why:
            notes.append(f"{case}: {CASES[case].tolerance.why}")
        doubtful = sum(result.doubtful for result in of_case)
        if doubtful:
            notes.append(f"{case}: {doubtful} pixels within rounding of a threshold are left out")
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join([*lines, *notes, *failures(results)])


def failures(results):
    lines = []
    for result in results:
        failed = [finding for finding in result.findings if not finding.passed]
        for finding in sorted(failed, key=lambda finding: -finding.share)[:MAX_FAILURES]:
            what = finding.problem or f"{finding.measure} error {finding.error:.2e}, tolerance {finding.tolerance:.0e}"
            lines.append(f"FAIL {result.case} (seed {result.seed}), {result.label}: {finding.tensor}: {what}")
        if len(failed) > MAX_FAILURES:
            lines.append(f"     and {len(failed) - MAX_FAILURES} more tensors of it")
    return lines


def self_test_report(results):
    tried = sum(result.tried for result in results)
    missed = [f"{result.case}, {result.label}: {what}" for result in results for what in result.missed]
    untested = [f"{result.case}, {result.label}" for result in results if not result.passed]
    lines = [f"self-test: {tried} perturbed answers, {tried - len(missed)} judged failures"]
    lines += [f"not detected: {what}" for what in missed]
    lines += [f"not tested, as the answer itself fails: {what}" for what in untested]
    return "\n".join(lines)
