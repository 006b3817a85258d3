"""The captures of the tests, and the check that they test the installed package, or the one that scripts/check_op.sh links."""

import os
import sys
from pathlib import Path

import globalsplat
import pytest


def pytest_configure():
    expected = os.environ.get("GLOBALSPLAT_PACKAGE", sys.prefix)
    assert Path(globalsplat.__file__).is_relative_to(expected), (
        f"{globalsplat.__file__} isn't the package in {expected}"
    )


@pytest.fixture(scope="session")
def capture_folder():
    """A real capture; without one the test is skipped, or fails if nothing may be skipped."""
    folder = Path(os.environ.get("GLOBALSPLAT_CAPTURES", "")) / "re10k" / "322261824c4a3003"
    if not folder.exists():
        if os.environ.get("GLOBALSPLAT_NO_SKIPS"):
            pytest.fail("there are no captures in GLOBALSPLAT_CAPTURES")
        pytest.skip("no captures in GLOBALSPLAT_CAPTURES")
    return folder
