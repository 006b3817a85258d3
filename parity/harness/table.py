"""Report of the results on the terminal and as JSON."""

MOST_FAILURES = 5  # maximum number of failures shown per draw

HEADER = ("case", "draws", "of", "worst draw", "worst tensor", "max abs", "rel L2", "tolerance", "verdict")
RIGHT = (1, 5, 6, 7)


def table(results):
    """Returns a table with two rows per case, for outputs and gradients: the worst tensor of all draws."""
    whys = []
    rows = [HEADER]
    for case, found in by_case(results).items():
        note = ""
        for why in dict.fromkeys(result.tolerance.why for result in found if result.tolerance.why):
            whys += [] if why in whys else [why]
            note += f" [{whys.index(why) + 1}]"
        first = case, str(len(found))
        for kind, is_kind in (("outputs", is_output), ("gradients", is_gradient)):
            pairs = [(result, finding) for result in found for finding in result.findings if is_kind(finding)]
            if pairs:
                rows.append((*first, kind, *worst(pairs, note)))
                first = "", ""
    lines = layout(rows)
    lines += [f"[{number}] {why}" for number, why in enumerate(whys, start=1)]
    return "\n".join([*lines, *doubtful(results), *flipped(results), *failures(results)])


def by_case(results):
    found = {}
    for result in results:
        found.setdefault(result.case, []).append(result)
    return found


def is_gradient(finding):
    return finding.tensor.startswith("grad.")


def is_output(finding):
    return not is_gradient(finding)


def worst(pairs, note):
    result, finding = max(pairs, key=lambda pair: pair[1].share)
    relative = "" if finding.relative is None else f"{finding.relative:.1e}"
    tolerance = "exact" if finding.measure == "exact" else f"{finding.tolerance:.0e} {finding.measure}"
    verdict = "ok" if all(other.passed for _, other in pairs) else "FAIL"
    tensor = finding.tensor.split(".", 1)[-1]
    return result.label, tensor, f"{finding.largest:.1e}", relative, tolerance, verdict + note


def layout(rows):
    widths = [max(len(row[k]) for row in rows) for k in range(len(HEADER))]
    lines = []
    for row in rows:
        cells = [
            cell.rjust(w) if k in RIGHT else cell.ljust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return [lines[0], "─" * max(map(len, lines)), *lines[1:]]


def doubtful(results):
    """Returns lines with the number of pixels that were not compared."""
    lines = []
    for case, found in by_case(results).items():
        counts = {}
        for result in found:
            if result.doubtful:
                counts[result.label] = counts.get(result.label, 0) + result.doubtful
        if counts:
            where = "; ".join(f"{count} of {label}" for label, count in counts.items())
            total = sum(counts.values())
            lines.append(f"{case}: {total} pixels within rounding of a threshold are left out ({where})")
    return lines


def flipped(results):
    """Returns lines with the number of close calls that the program decided differently from the reference."""
    counts = {case: sum(result.flipped for result in found) for case, found in by_case(results).items()}
    what = "numbers within rounding of a threshold lie on its other side"
    return [f"{case}: {count} {what}" for case, count in counts.items() if count]


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


def list_undetected(results):
    """Returns the perturbed results that pass nevertheless."""
    return [f"{result.case}, {result.label}: {what}" for result in results for what in result.missed]


def self_test_report(results):
    tried = sum(result.tried for result in results)
    missed = list_undetected(results)
    untested = [f"{result.case}, {result.label}" for result in results if not result.passed]
    lines = [f"self-test: {tried} perturbed answers, {tried - len(missed)} judged failures"]
    lines += [f"not detected: {what}" for what in missed]
    lines += [f"not tested, as the answer itself fails: {what}" for what in untested]
    return "\n".join(lines)


def as_json(results, **about):
    """Returns the results of every tensor of every draw as a JSON value."""
    draws = [
        {
            "case": result.case,
            "draw": result.label,
            "seed": result.seed,
            "passed": result.passed,
            "why": result.tolerance.why,
            "doubtful_pixels": result.doubtful,
            "turned_close_calls": result.flipped,
            "reference_seconds": round(result.seconds, 3),
            "disturbed": result.tried,
            "undetected": result.missed,
            "tensors": [
                {
                    "tensor": finding.tensor,
                    "shape": list(finding.shape),
                    "measure": finding.measure,
                    "error": number(finding.error),
                    "tolerance": finding.tolerance,
                    "max_abs": number(finding.largest),
                    "relative_l2": finding.relative,
                    "passed": finding.passed,
                    "problem": finding.problem,
                }
                for finding in result.findings
            ],
        }
        for result in results
    ]
    return about | {"passed": all(result.passed for result in results), "draws": draws}


def number(value):
    """Returns None for infinity, the error of a tensor that can't be compared, because JSON has no infinity."""
    return value if value != float("inf") else None
