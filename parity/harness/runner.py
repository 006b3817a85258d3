"""Draws random inputs of cases, runs the program and the reference on them, and compares the results.

Requests and answers are folders of safetensors files. A request contains `case` (JSON: the module, its config, the inputs to
differentiate), param.X, in.X, and cot.Y for every output Y that has a gradient. An answer contains out.Y and, if there are
cotangents, grad.param.X and grad.in.X, the gradients of sum over Y of sum(cot.Y out.Y); or `error`, a text.
"""

import json
import subprocess
import tempfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import load_file, save_file

from .compare import compare, find_undetected
from .registry import CASES

THREADS = 2  # for large draws; small ones are faster on one thread


class ProgramError(Exception):
    """The program ended without answers."""


@dataclass
class Result:
    """The comparison of one draw of one case."""

    case: str
    label: str
    seed: int
    findings: list
    doubtful: int  # number of pixels excluded from the comparison
    tried: int = 0  # number of perturbed results
    missed: list = field(default_factory=list)  # perturbed results that pass

    @property
    def passed(self):
        return all(finding.passed for finding in self.findings)


def write_request(path, name, drawn, cotangents):
    about = {"case": CASES[name].module, "config": drawn.config, "differentiate": list(drawn.differentiate)}
    arrays = {"case": np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)}
    params = {key.removeprefix(drawn.prefix): value for key, value in drawn.params.items()}
    for kind, group in (("param", params), ("in", drawn.inputs), ("cot", cotangents)):
        arrays |= {f"{kind}.{key}": np.ascontiguousarray(value) for key, value in group.items()}
    save_file(arrays, path)


def evaluate(name, drawn, rng):
    """Returns the reference's outputs and gradients as arrays, with the names of an answer, and the cotangents of the outputs."""
    dtype = torch.float32 if drawn.is_large else torch.float64
    torch.set_num_threads(THREADS if drawn.is_large else 1)

    def tensors(group, differentiated):
        values = {}
        for key, array in group.items():
            value = torch.tensor(array)
            values[key] = value.to(dtype).requires_grad_(key in differentiated) if value.is_floating_point() else value
        return values

    params, inputs = tensors(drawn.params, drawn.params), tensors(drawn.inputs, drawn.differentiate)
    outputs = CASES[name].evaluate(drawn.config, params, inputs)
    expected = {f"out.{key}": np.atleast_1d(value.detach().numpy()) for key, value in outputs.items()}
    if not drawn.has_gradients:
        return expected, {}
    cotangents = draw_cotangents(rng, drawn, expected)
    leaves = {f"grad.param.{key.removeprefix(drawn.prefix)}": value for key, value in params.items()}
    leaves |= {f"grad.in.{key}": inputs[key] for key in drawn.differentiate}
    total = torch.tensor(0.0)
    for key, cotangent in cotangents.items():
        total = total + (torch.tensor(cotangent).to(dtype).reshape(outputs[key].shape) * outputs[key]).sum()
    gradients = torch.autograd.grad(total, list(leaves.values()), allow_unused=True)
    for (key, leaf), gradient in zip(leaves.items(), gradients, strict=True):
        expected[key] = (torch.zeros_like(leaf) if gradient is None else gradient).detach().numpy()
    return expected, cotangents


def draw_cotangents(rng, drawn, outputs):
    """Returns standard normal cotangents of every differentiable output, 0 at pixels that can't be compared."""
    is_double = any(value.dtype == np.float64 for value in drawn.inputs.values())
    found = {}
    for name, value in outputs.items():
        if value.dtype.kind == "i":
            continue
        cotangent = rng.standard_normal(value.shape)
        if drawn.doubtful is not None:
            cotangent *= ~drawn.doubtful[:, :, None] if value.ndim == 5 else ~drawn.doubtful
        found[name.removeprefix("out.")] = cotangent.astype(np.float64 if is_double else np.float32)
    return found


def run_program(binary, device, requests, answers):
    """Runs the program on a folder of requests."""
    command = [binary, "parity", "--requests", requests, "--responses", answers, "--device", device]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
    if done.returncode != 0:
        raise ProgramError(f"{binary} parity ended with {done.returncode}: {done.stdout.strip()[-2000:]}")


def read_answer(path):
    """Reads an answer as arrays by name. An error or a missing answer is returned as `error` alone."""
    if not path.exists():
        return {"error": "no answer"}
    arrays = load_file(path)
    if "error" in arrays:
        return {"error": bytes(arrays["error"]).decode(errors="replace")}
    return arrays


def run_cases(names, seed, binary, device, self_test):
    """Yields a Result for every draw of the named cases. The cases `self_test` also check that wrong results are detected."""
    with tempfile.TemporaryDirectory(prefix="globalsplat-parity-") as folder:
        requests, answers = Path(folder, "requests"), Path(folder, "answers")
        requests.mkdir()
        answers.mkdir()
        evaluated = []
        for name in names:
            # A case's numbers don't depend on the other cases that are run.
            rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
            for drawn in CASES[name].draws(rng):
                expected, cotangents = evaluate(name, drawn, rng)
                file = f"{len(evaluated):04}_{name}.safetensors"
                write_request(requests / file, name, drawn, cotangents)
                evaluated.append((name, drawn, expected, file))
        run_program(binary, device, requests, answers)
        for name, drawn, expected, file in evaluated:
            answer, tolerance = read_answer(answers / file), CASES[name].tolerance
            findings = compare(answer, expected, tolerance, drawn.doubtful)
            doubtful = 0 if drawn.doubtful is None else int(drawn.doubtful.sum())
            result = Result(name, drawn.label, seed, findings, doubtful)
            if name in self_test and result.passed:
                result.tried, result.missed = find_undetected(answer, expected, tolerance, drawn.doubtful)
            yield result
