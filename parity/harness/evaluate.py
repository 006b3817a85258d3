"""The reference's answer to a request."""

from contextlib import nullcontext

import numpy as np
import torch

from .areas import TWINS
from .close_calls import Turned
from .exchange import read_request, write_answer


class Evaluation:
    """Outputs on construction; gradients when their cotangents are known.

    `dtype` is the precision of the arithmetic; what is not a floating-point number stays what it is. Of the twin's close calls, `calls`
    are decided otherwise.
    """

    def __init__(self, request, dtype, calls=()):
        def tensors(group, differentiate):
            values = {}
            for name, array in group.items():
                value = torch.tensor(array)
                if value.is_floating_point():
                    value = value.to(dtype).requires_grad_(differentiate(name))
                values[name] = value
            return values

        params = tensors(request.params, lambda name: True)
        inputs = tensors(request.inputs, lambda name: name in request.differentiate)
        with Turned(calls) if calls else nullcontext():
            self.outputs = TWINS[request.module](request.config, params, inputs)
        self.leaves = {f"grad.param.{name}": value for name, value in params.items()}
        self.leaves |= {f"grad.in.{name}": inputs[name] for name in request.differentiate}

    def output_arrays(self):
        """As out.Y; a loss, which has no dimension, as one number in a row."""
        return {f"out.{name}": np.atleast_1d(value.detach().numpy()) for name, value in self.outputs.items()}

    def gradient_arrays(self, cotangents):
        """As grad.param.X and grad.in.X: of the sum of cotangent times output."""
        total = 0.0
        for name, cotangent in cotangents.items():
            output = self.outputs[name]
            total = total + (torch.tensor(cotangent).to(output.dtype).reshape(output.shape) * output).sum()
        gradients = torch.autograd.grad(total, list(self.leaves.values()), allow_unused=True)
        return {
            name: (torch.zeros_like(leaf) if gradient is None else gradient).detach().numpy()
            for (name, leaf), gradient in zip(self.leaves.items(), gradients)
        }


def answer_files(requests, answers, on_progress=lambda done: None):
    """The reference in the program's place: answers a folder of requests, in the precision they are written in."""
    for done, path in enumerate(sorted(requests.glob("*.npz")), start=1):
        request = read_request(path)
        kinds = {array.dtype for array in [*request.params.values(), *request.inputs.values()]}
        double = np.dtype(np.float64) in kinds
        evaluation = Evaluation(request, torch.float64 if double else torch.float32)
        answer = evaluation.output_arrays()
        if request.cotangents:
            answer |= evaluation.gradient_arrays(request.cotangents)
        write_answer(answers / path.name, answer)
        on_progress(done)
