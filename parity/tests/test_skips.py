"""Tests that skipped tests are counted by missing requirement, and that they fail if skips are not allowed."""

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
    "test_xfail": "import pytest\n@pytest.mark.xfail\ndef test(): assert False\n",
    "test_passes": "def test(): pass\n",
}


def run(folder, *command, **variables):
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("GLOBALSPLAT_")}
    paths = {"PYTHONPATH": str(REPOSITORY / "parity" / "tests")}
    return subprocess.run(
        command, cwd=folder, env=inherited | paths | variables, capture_output=True, text=True, check=False
    )


def run_pytest(folder, *arguments, **variables):
    # Loads parity/tests/conftest.py, which is on PYTHONPATH.
    options = ["-m", "pytest", "-q", "-p", "conftest", "-p", "no:cacheprovider", "--continue-on-collection-errors"]
    return run(folder, sys.executable, *options, *arguments, **variables)


@pytest.fixture
def tests(tmp_path):
    for name, text in TESTS.items():
        (tmp_path / f"{name}.py").write_text(text)
    return tmp_path


def test_skips_are_counted(tests):
    log = tests / "skipped"
    result = run_pytest(tests, GLOBALSPLAT_SKIPPED=str(log))
    assert result.returncode == 0 and "1 passed, 3 skipped, 1 xfailed" in result.stdout, result.stdout
    assert sorted(log.read_text().splitlines()) == [
        "could not import 'no_such_module'",
        "golden tensors",
        "golden tensors",
    ]
    assert run_pytest(tests).returncode == 0


def test_skips_fail_if_not_allowed(tests):
    result = run_pytest(tests, GLOBALSPLAT_NO_SKIPS="1")
    assert result.returncode == 1 and "1 failed, 1 passed, 1 xfailed, 2 errors" in result.stdout, result.stdout
    assert result.stdout.count("no test may be skipped, but this was: golden tensors: nowhere") >= 2


def test_missing_golden_files_fail_but_a_missing_golden_folder_skips(tmp_path):
    encoder = [REPOSITORY / "parity" / "tests" / "test_reference.py", "-k", "test_encoder"]
    result = run_pytest(tmp_path, *encoder, GLOBALSPLAT_GOLDEN=str(tmp_path))
    assert result.returncode == 1 and "2 failed" in result.stdout, result.stdout
    result = run_pytest(tmp_path, *encoder, GLOBALSPLAT_GOLDEN=str(tmp_path / "absent"))
    assert result.returncode == 0 and "2 skipped" in result.stdout, result.stdout


@pytest.mark.parametrize(
    "lines, summary",
    [
        ("", "0 tests skipped"),
        ("a browser\n", "1 test skipped: a browser (1)"),
        ("golden tensors\na browser\ngolden tensors\n", "3 tests skipped: a browser (1), golden tensors (2)"),
    ],
)
def test_last_line_is_a_summary_of_skips(tmp_path, lines, summary):
    program = "from os import environ as e; open(e['GLOBALSPLAT_SKIPPED'], 'a').write(e['LINES']); print('done')"
    script = REPOSITORY / "scripts" / "count_skips.sh"
    result = run(tmp_path, str(script), sys.executable, "-c", program, LINES=lines)
    assert result.stdout.splitlines() == ["done", summary]
    failed = run(tmp_path, str(script), sys.executable, "-c", f"{program}; exit(7)", LINES=lines)
    assert failed.returncode == 7 and failed.stdout == result.stdout
