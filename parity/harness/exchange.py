"""Exchange of requests and answers with the program, as folders of npz files.

A request contains `case` (JSON: the module, its config, the inputs to differentiate), param.X, in.X, and cot.Y for
every output Y that has a gradient. An answer contains out.Y and, if there are cotangents, grad.param.X and grad.in.X,
the gradients of sum over Y of sum(cot.Y out.Y); or `error`, a text.
"""

import json
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np


@dataclass
class Request:
    """A request to the program. `module` is the name of the computation in the program and in the reference."""

    module: str
    config: dict
    params: dict = field(default_factory=dict)
    inputs: dict = field(default_factory=dict)
    cotangents: dict = field(default_factory=dict)
    differentiate: tuple = ()


class ProgramError(Exception):
    """The program ended without answers."""


def text(words):
    return np.frombuffer(words.encode(), dtype=np.uint8)


def write_request(path, request):
    case = {"case": request.module, "config": request.config, "differentiate": list(request.differentiate)}
    arrays = {"case": text(json.dumps(case))}
    groups = (("param", request.params), ("in", request.inputs), ("cot", request.cotangents))
    for prefix, group in groups:
        arrays |= {f"{prefix}.{name}": np.ascontiguousarray(value) for name, value in group.items()}
    np.savez(path, **arrays)


def read_answer(path):
    """Reads an answer as arrays by name. An error or a missing answer is returned as `error` alone."""
    if not path.exists():
        return {"error": "no answer"}
    with np.load(path) as file:
        arrays = dict(file)
    if "error" in arrays:
        return {"error": bytes(arrays["error"]).decode(errors="replace")}
    return arrays


def program(binary, device="cpu"):
    """Returns a function that runs the program on a folder of requests.

    Its arguments are the folder of requests, the folder for answers, and a callback that gets the number of answers.
    """

    def answer(requests, answers, on_progress):
        command = [binary, "parity", "--requests", requests, "--responses", answers, "--device", device]
        with tempfile.TemporaryFile() as messages:
            process = subprocess.Popen([str(word) for word in command], stdout=messages, stderr=messages)
            while process.poll() is None:
                on_progress(sum(1 for _ in answers.iterdir()))
                time.sleep(0.1)
            if process.returncode != 0:
                messages.seek(0)
                said = messages.read().decode(errors="replace").strip()
                raise ProgramError(f"{binary} parity ended with {process.returncode}: {said[-2000:]}")

    return answer


def exchange(requests, answerer, on_progress=lambda done: None):
    """Yields the answers to `requests` in order, after all of them are complete."""
    with tempfile.TemporaryDirectory(prefix="globalsplat-parity-") as folder:
        requests_folder, answers_folder = Path(folder, "requests"), Path(folder, "answers")
        requests_folder.mkdir()
        answers_folder.mkdir()
        names = [f"{number:04}_{request.module}.npz" for number, request in enumerate(requests)]
        for name, request in zip(names, requests, strict=True):
            write_request(requests_folder / name, request)
        answerer(requests_folder, answers_folder, on_progress)
        for name in names:
            yield read_answer(answers_folder / name)
