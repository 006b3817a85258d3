"""Report of the results on the terminal."""

from .compare import is_gradient

MOST_FAILURES = 5  # maximum number of failures shown per draw

HEADER = ("case", "draws", "of", "worst draw", "worst tensor", "max abs", "rel L2", "tolerance", "verdict")
RIGHT = (1, 5, 6, 7)
LONGEST_LABEL = 48


def table(results):
    """Returns a table with two rows per case, for outputs and gradients: the worst tensor of all draws."""
    whys, rows, lines = [], [HEADER], []
    for case, found in by_case(results).items():
        why, note = found[0].tolerance.why, ""
        if why:
            whys += [] if why in whys else [why]
            note = f" [{whys.index(why) + 1}]"
        first = case, str(len(found))
        for kind, of_gradients in (("outputs", False), ("gradients", True)):
            pairs = [(result, f) for result in found for f in result.findings if is_gradient(f.tensor) == of_gradients]
            if pairs:
                rows.append((*first, kind, *worst(pairs, note)))
                first = "", ""
        doubtful = sum(result.doubtful for result in found)
        if doubtful:
            lines.append(f"{case}: {doubtful} pixels within rounding of a threshold are left out")
    notes = [f"[{number}] {why}" for number, why in enumerate(whys, start=1)]
    return "\n".join([*layout(rows), *notes, *lines, *failures(results)])


def by_case(results):
    found = {}
    for result in results:
        found.setdefault(result.case, []).append(result)
    return found


def worst(pairs, note):
    result, finding = max(pairs, key=lambda pair: pair[1].share)
    relative = "" if finding.relative is None else f"{finding.relative:.1e}"
    tolerance = "exact" if finding.measure == "exact" else f"{finding.tolerance:.0e} {finding.measure}"
    verdict = "ok" if all(other.passed for _, other in pairs) else "FAIL"
    tensor = finding.tensor.split(".", 1)[-1]
    return result.label[:LONGEST_LABEL], tensor, f"{finding.largest:.1e}", relative, tolerance, verdict + note


def layout(rows):
    widths = [max(len(row[k]) for row in rows) for k in range(len(HEADER))]
    lines = []
    for row in rows:
        cells = zip(range(len(row)), row, widths, strict=True)
        lines.append("  ".join(cell.rjust(w) if k in RIGHT else cell.ljust(w) for k, cell, w in cells).rstrip())
    return [lines[0], "─" * max(map(len, lines)), *lines[1:]]


def failures(results):
    lines = []
    for result in results:
        failed = [finding for finding in result.findings if not finding.passed]
        for finding in sorted(failed, key=lambda finding: -finding.share)[:MOST_FAILURES]:
            what = finding.problem or f"{finding.measure} error {finding.error:.2e}, tolerance {finding.tolerance:.0e}"
            lines.append(f"FAIL {result.case} (seed {result.seed}), {result.label}: {finding.tensor}: {what}")
        if len(failed) > MOST_FAILURES:
            lines.append(f"     and {len(failed) - MOST_FAILURES} more tensors of it")
    return lines


def self_test_report(results):
    tried = sum(result.tried for result in results)
    missed = [f"{result.case}, {result.label}: {what}" for result in results for what in result.missed]
    untested = [f"{result.case}, {result.label}" for result in results if not result.passed]
    lines = [f"self-test: {tried} perturbed answers, {tried - len(missed)} judged failures"]
    lines += [f"not detected: {what}" for what in missed]
    lines += [f"not tested, as the answer itself fails: {what}" for what in untested]
    return "\n".join(lines)
