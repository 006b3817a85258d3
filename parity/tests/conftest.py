"""What is skipped is counted by `make test`, and is a failure where nothing may be: as by `skip` in tests/common/mod.rs."""

import os
from pathlib import Path

import pytest


def told(report):
    """A skip says what it is for want of before a colon."""
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
    return told((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report():
    return told((yield))
