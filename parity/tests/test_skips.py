"""Tests that skipped tests are counted by missing requirement, and fail if skips are not allowed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
TESTS = {
    "test_module": "import pytest\npytest.importorskip('no_such_module')\n",
    "test_function": "import pytest\ndef test(): pytest.skip('golden tensors: nowhere')\n",
    "test_mark": "import pytest\n@pytest.mark.skip(reason='golden tensors: nowhere')\ndef test(): pass\n",
    "test_expected": "import pytest\n@pytest.mark.xfail\ndef test(): assert False\n",
    "test_passes": "def test(): pass\n",
}


def run(folder, *command, **variables):
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("GLOBALSPLAT_")}
    paths = {"PYTHONPATH": str(REPOSITORY / "parity" / "tests")}
    return subprocess.run(
        command, cwd=folder, env=inherited | paths | variables, capture_output=True, text=True, check=False
    )


def pytest_on(folder, *arguments, **variables):
    words = ["-m", "pytest", "-q", "-p", "conftest", "-p", "no:cacheprovider", "--continue-on-collection-errors"]
    return run(folder, sys.executable, *words, *arguments, **variables)


@pytest.fixture
def tests(tmp_path):
    for name, text in TESTS.items():
        (tmp_path / f"{name}.py").write_text(text)
    return tmp_path


def test_skips_are_counted(tests):
    counted = tests / "skipped"
    told = pytest_on(tests, GLOBALSPLAT_SKIPPED=str(counted))
    assert told.returncode == 0 and "1 passed, 3 skipped, 1 xfailed" in told.stdout, told.stdout
    assert sorted(counted.read_text().splitlines()) == [
        "could not import 'no_such_module'",
        "golden tensors",
        "golden tensors",
    ]
    assert pytest_on(tests).returncode == 0


def test_skips_fail_where_none_may_be(tests):
    told = pytest_on(tests, GLOBALSPLAT_NO_SKIPS="1")
    assert told.returncode == 1 and "1 failed, 1 passed, 1 xfailed, 2 errors" in told.stdout, told.stdout
    assert told.stdout.count("no test may be skipped, but this was: golden tensors: nowhere") >= 2


def test_a_folder_without_goldens_fails(tmp_path):
    encoder = [REPOSITORY / "parity" / "tests" / "test_reference.py", "-k", "test_encoder"]
    told = pytest_on(tmp_path, *encoder, GLOBALSPLAT_GOLDEN=str(tmp_path))
    assert told.returncode == 1 and "2 failed" in told.stdout, told.stdout
    told = pytest_on(tmp_path, *encoder, GLOBALSPLAT_GOLDEN=str(tmp_path / "absent"))
    assert told.returncode == 0 and "2 skipped" in told.stdout, told.stdout


@pytest.mark.parametrize(
    "lines, said",
    [
        ("", "0 tests skipped"),
        ("a browser\n", "1 test skipped: a browser (1)"),
        ("golden tensors\na browser\ngolden tensors\n", "3 tests skipped: a browser (1), golden tensors (2)"),
    ],
)
def test_the_last_line_counts(tmp_path, lines, said):
    tell = "from os import environ as e; open(e['GLOBALSPLAT_SKIPPED'], 'a').write(e['LINES']); print('done')"
    script = REPOSITORY / "scripts" / "count_skips.sh"
    told = run(tmp_path, str(script), sys.executable, "-c", tell, LINES=lines)
    assert told.stdout.splitlines() == ["done", said]
    failed = run(tmp_path, str(script), sys.executable, "-c", f"{tell}; exit(7)", LINES=lines)
    assert failed.returncode == 7 and failed.stdout == told.stdout
