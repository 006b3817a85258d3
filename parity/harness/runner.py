"""Draws random inputs of cases, runs the program and the reference on them, and compares the results."""

import time
import zlib
from dataclasses import dataclass, field

import numpy as np
import torch

from .areas import CASES
from .close_calls import resolve_close_calls
from .compare import compare
from .evaluate import Evaluation
from .exchange import Request, exchange
from .perturb import find_undetected
from .registry import Draw
from .tolerance import Tolerance

THREADS = 2  # for large cases; small ones are faster on one thread


@dataclass
class Result:
    """The comparison of one draw of one case."""

    case: str
    label: str
    seed: int
    tolerance: Tolerance
    findings: list
    doubtful: int  # number of pixels excluded from the comparison
    seconds: float  # time of the reference
    large: bool = False  # whether the reference computed in float32, too
    flipped: int = 0  # number of close calls that the program decided differently
    tried: int = 0  # number of perturbed results
    missed: list = field(default_factory=list)  # perturbed results that pass

    @property
    def passed(self):
        return all(finding.passed for finding in self.findings)


@dataclass
class PreparedCase:
    """A draw with its request and the reference's result."""

    case: str
    drawn: Draw
    request: Request
    expected: dict
    seconds: float

    def resolve_close_calls(self, answer):
        """Returns the expected tensors with the program's choice of close calls, and the number that differ."""

        def flipped(calls):
            evaluation = Evaluation(self.request, torch.float64, calls)
            return evaluation.gradient_arrays(self.request.cotangents)

        return resolve_close_calls(answer, self.expected, self.drawn.close_calls(), flipped)


def generator(seed, case):
    """Returns the random generator of a case, which doesn't depend on the other cases that are run."""
    return np.random.default_rng([seed, zlib.crc32(case.encode())])


def prepare_cases(names, seed):
    """Yields the draws of the named cases with the reference's results."""
    for name in names:
        rng = generator(seed, name)
        for drawn in CASES[name](rng):
            started = time.perf_counter()
            request = Request(
                drawn.module or name, drawn.config, drawn.params, drawn.inputs, differentiate=drawn.differentiate
            )
            torch.set_num_threads(THREADS if drawn.large else 1)
            evaluation = Evaluation(request, torch.float32 if drawn.large else torch.float64)
            expected = evaluation.output_arrays()
            if drawn.gradients:
                request.cotangents = cotangents(rng, request, expected, drawn.doubtful)
                expected |= evaluation.gradient_arrays(request.cotangents)
            yield PreparedCase(name, drawn, request, expected, time.perf_counter() - started)


def cotangents(rng, request, outputs, doubtful):
    """Returns standard normal cotangents of every differentiable output, 0 at pixels that can't be compared."""
    double = any(value.dtype == np.float64 for value in request.inputs.values())
    drawn = {}
    for name, value in outputs.items():
        if value.dtype.kind == "i":
            continue
        cotangent = rng.standard_normal(value.shape)
        if doubtful is not None:
            cotangent *= ~doubtful[:, :, None] if value.ndim == 5 else ~doubtful
        drawn[name.removeprefix("out.")] = cotangent.astype(np.float64 if double else np.float32)
    return drawn


def run_cases(names, seed, answerer, self_test=(), on_progress=lambda text: None, on_gpu=False):
    """Yields a Result for every draw of the named cases. The cases `self_test` also check that wrong results are detected."""
    prepared = []
    for question in prepare_cases(names, seed):
        prepared.append(question)
        on_progress(f"reference, {len(prepared)} draws: {question.case}, {question.drawn.label}")

    def on_answers(done):
        at = prepared[min(done, len(prepared) - 1)]
        on_progress(f"program, {done} of {len(prepared)} draws: {at.case}, {at.drawn.label}")

    answers = exchange([question.request for question in prepared], answerer, on_answers)
    for done, (question, answer) in enumerate(zip(prepared, answers, strict=True), start=1):
        drawn = question.drawn
        on_progress(f"comparison, {done} of {len(prepared)} draws: {question.case}, {drawn.label}")
        tolerance = (on_gpu and drawn.on_gpu) or drawn.tolerance
        expected, flipped = question.expected, 0
        findings = compare(answer, expected, tolerance, drawn.doubtful)
        failed = [finding for finding in findings if not finding.passed]
        # Only a gradient that has its shape may be on the other side of a threshold.
        if on_gpu and failed and all(f.tensor.startswith("grad.") and not f.problem for f in failed):
            expected, flipped = question.resolve_close_calls(answer)
            findings = compare(answer, expected, tolerance, drawn.doubtful)
        doubtful = 0 if drawn.doubtful is None else int(drawn.doubtful.sum())
        result = Result(
            question.case, drawn.label, seed, tolerance, findings, doubtful, question.seconds, drawn.large, flipped
        )
        if question.case in self_test and result.passed:
            result.tried, result.missed = find_undetected(answer, expected, tolerance, drawn.doubtful)
        yield result
