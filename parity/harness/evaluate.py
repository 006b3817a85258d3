"""Evaluation of a request by the reference."""

from contextlib import nullcontext

import numpy as np
import torch

from .areas import REFERENCES
from .close_calls import FlippedDecisions


class Evaluation:
    """Evaluation of the reference: computes outputs on construction, and gradients for given cotangents.

    `dtype` is the precision of floating-point tensors; other tensors keep their dtype. The close calls in `calls` are
    decided the other way.
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
        with FlippedDecisions(calls) if calls else nullcontext():
            self.outputs = REFERENCES[request.module](request.config, params, inputs)
        self.leaves = {f"grad.param.{name}": value for name, value in params.items()}
        self.leaves |= {f"grad.in.{name}": inputs[name] for name in request.differentiate}

    def output_arrays(self):
        """Returns the outputs as arrays named out.Y; a scalar loss has shape [1]."""
        return {f"out.{name}": np.atleast_1d(value.detach().numpy()) for name, value in self.outputs.items()}

    def gradient_arrays(self, cotangents):
        """Returns the gradients of the sum of cotangent times output, as arrays named grad.param.X and grad.in.X."""
        total = torch.tensor(0.0)
        for name, cotangent in cotangents.items():
            output = self.outputs[name]
            total = total + (torch.tensor(cotangent).to(output.dtype).reshape(output.shape) * output).sum()
        gradients = torch.autograd.grad(total, list(self.leaves.values()), allow_unused=True)
        return {
            name: (torch.zeros_like(leaf) if gradient is None else gradient).detach().numpy()
            for (name, leaf), gradient in zip(self.leaves.items(), gradients, strict=True)
        }
