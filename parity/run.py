"""Compares outputs and gradients of the Rust program with the PyTorch reference, module by module, on random inputs.

    python parity/run.py                         runs all cases, in about a minute
    python parity/run.py --only 'rasterizer*'    runs the cases whose names match
    python parity/run.py --self-test             also checks that wrong results are detected
    python parity/run.py --self-test 2/5         checks this for every fifth case, beginning with the third
    python parity/run.py --only '*float32,ssim' --cuda-on-cpu 1    runs the CUDA kernels, emulated on the CPU

Exits with 1 if a comparison fails, and with 2 if the request is wrong.
"""

import argparse
import os
import sys
import time
from fnmatch import fnmatchcase
from pathlib import Path

# The folder of the package parity, if this file is run as a script.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # noqa: TID251

import parity.cases  # noqa: F401
from parity.harness.registry import CASES
from parity.harness.report import self_test_report, table
from parity.harness.runner import ProgramError, run_cases

PROGRAM = Path(__file__).resolve().parents[1] / "target" / "release" / "globalsplat"
WRONG_REQUEST = 2


def sample(text):
    """Parses K/N, the cases whose index modulo N is K."""
    try:
        index, count = map(int, text.split("/"))
    except ValueError:
        index, count = 0, 0
    if not 0 <= index < count:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected K/N with 0 <= K < N")
    return index, count


def arguments(argv):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    option = parser.add_argument
    option("--only", metavar="PATTERNS", default="*", help="comma-separated shell patterns of case names")
    option("--seed", metavar="N", type=int, default=0, help="seed of the random numbers (default: 0)")
    option("--repeat", metavar="N", type=int, default=1, help="number of seeds (default: 1)")
    option("--device", default="cpu", help="device of the program: cpu, cuda or cuda:N (default: cpu)")
    option(
        "--program",
        metavar="FILE",
        type=Path,
        default=PROGRAM,
        help="program to compare (default: target/release/globalsplat)",
    )
    emulated = "run float32 with the CUDA kernels, emulated on the CPU; N seeds the order of blocks and threads"
    option("--cuda-on-cpu", metavar="N", type=int, help=emulated)
    perturb = "perturb correct results and check detection, of all cases, or of those whose index modulo N is K"
    option("--self-test", metavar="K/N", type=sample, nargs="?", const=(0, 1), help=perturb)
    return parser.parse_args(argv)


def main(argv=None):
    options = arguments(argv)
    names = [name for name in CASES if any(fnmatchcase(name, pattern) for pattern in options.only.split(","))]
    if not names:
        print(f"--only {options.only}: no such case, there are {', '.join(CASES)}", file=sys.stderr)
        return WRONG_REQUEST
    if not options.program.is_file():
        print(f"{options.program} doesn't exist: run make build", file=sys.stderr)
        return WRONG_REQUEST

    if options.cuda_on_cpu is not None:
        os.environ["GLOBALSPLAT_CUDA_ON_CPU"] = str(options.cuda_on_cpu)
    index, count = options.self_test or (0, 1)
    self_tested = names[index::count] if options.self_test else []
    started, results = time.perf_counter(), []
    try:
        for seed in range(options.seed, options.seed + options.repeat):
            results += run_cases(names, seed, options.program, options.device, self_tested)
    except ProgramError as error:
        print(error, file=sys.stderr)
        return 1

    print(table(results))
    failed = sum(not result.passed for result in results)
    print(f"{len(results)} draws, {failed} failed, {time.perf_counter() - started:.0f} s")
    if options.self_test:
        print(self_test_report(results))
    return 1 if failed or any(result.missed for result in results) else 0


if __name__ == "__main__":
    sys.exit(main())
