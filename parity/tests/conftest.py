"""Hooks that count skipped tests for `make test`, or make skips failures, like `skip` in tests/common/mod.rs."""

import os
from pathlib import Path

import pytest


def handle_skip(report):
    """Records a skipped test, or makes it fail. The reason is the missing requirement, a colon and details."""
    if report.skipped and not hasattr(report, "wasxfail"):
        _, _, reason = report.longrepr
        reason = reason.removeprefix("Skipped: ")
        if os.environ.get("GLOBALSPLAT_NO_SKIPS"):
            report.outcome, report.longrepr = "failed", f"no test may be skipped, but this was: {reason}"
        elif file := os.environ.get("GLOBALSPLAT_SKIPPED"):
            with Path(file).open("a") as lines:
                lines.write(reason.partition(": ")[0] + "\n")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    return handle_skip((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report():
    return handle_skip((yield))
