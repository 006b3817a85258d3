"""Tests that the comparison of parity/run.py accepts rounding errors and nothing else, on results made by hand."""

import numpy as np
import pytest
import torch

from parity.harness import draw, scenes
from parity.harness.compare import compare
from parity.harness.evaluate import Evaluation
from parity.harness.perturb import find_undetected
from parity.harness.runner import prepare_cases
from parity.harness.thresholds import doubtful_pixels
from parity.harness.tolerance import FLOAT32, FLOAT64

torch.set_num_threads(1)


def canned():
    """Returns a result of an imaginary module, with a square matrix, a gradient of zero and integers."""
    rng = np.random.default_rng(0)
    return {
        "out.slots": draw.normal(rng, 2, 3, 4),
        "out.index": np.arange(5),
        "grad.param.weight": draw.normal(rng, 4, 4),
        "grad.param.mem_k.bias": draw.normal(rng, 4, scale=1e-8),
        "grad.in.gate": np.zeros((2, 3), np.float32),
    }


def passes(answer, expected, tolerance=FLOAT32, doubtful=None):
    return all(finding.passed for finding in compare(answer, expected, tolerance, doubtful))


def test_the_same_numbers_pass():
    assert passes(canned(), canned())
    rounded = canned() | {"out.slots": canned()["out.slots"] * np.float32(1 + 1e-6)}
    assert passes(rounded, canned())
    assert not passes(rounded, canned(), FLOAT64)


@pytest.mark.parametrize(
    "name, wrong",
    [
        ("out.slots", lambda x: x * 1.001),
        ("out.slots", lambda x: x[:1]),
        ("out.slots", lambda x: x.swapaxes(0, 1)),
        ("out.index", lambda x: x + 1),
        ("grad.param.weight", lambda x: x.T),
        ("grad.param.weight", lambda x: np.where(x == x.max(), np.nan, x)),
        ("grad.param.weight", lambda x: np.where(x == x.max(), np.inf, x)),
        ("grad.param.mem_k.bias", lambda x: x + 1e-3),
        ("grad.in.gate", lambda x: x + 1e-3),
    ],
)
def test_a_wrong_tensor_fails_alone(name, wrong):
    findings = compare(canned() | {name: wrong(canned()[name])}, canned(), FLOAT32)
    assert [finding.tensor for finding in findings if not finding.passed] == [name]


def test_missing_unasked_and_failed_answers_fail():
    expected = canned()
    without = {name: value for name, value in expected.items() if name != "grad.in.gate"}
    assert [f.problem for f in compare(without, expected, FLOAT32) if not f.passed] == ["missing"]
    strange = expected | {"out.more": np.zeros(1)}
    assert [f.tensor for f in compare(strange, expected, FLOAT32) if not f.passed] == ["out.more"]
    assert [f.problem for f in compare({"error": "no such case"}, expected, FLOAT32)] == ["no such case"]


def test_every_perturbation_of_a_correct_answer_is_detected():
    tried, missed = find_undetected(canned(), canned(), FLOAT32)
    assert tried > 15 and missed == []


def test_a_comparison_that_excludes_all_pixels_is_detected():
    """If all pixels are excluded, images with any values pass."""
    pictures = {"out.alpha": np.full((1, 1, 2, 3), 0.5)}
    tried, missed = find_undetected(pictures, pictures, FLOAT32, np.ones((1, 1, 2, 3), bool))
    assert "out.alpha: times 1.001" in missed and "out.alpha: slice 0 of axis 2 dropped" in missed
    assert len(missed) == tried - 2  # all except "left out" and "not a number"


@pytest.mark.parametrize(
    "opacities, depths, expected",
    [
        ([0.5], [1.0], False),
        ([1.0 / 255.0], [1.0], True),
        ([0.999], [1.0], True),
        ([0.99, 0.99], [1.0, 2.0], True),  # T falls to 1e-4
        ([0.9, 0.5, 0.5], [1.0, 2.0, 2.0], False),  # equal depths have an order
        ([0.9, 0.5, 0.5], [1.0, 2.0, 2.0 + 1e-6], True),
    ],
)
def test_doubtful_pixels(opacities, depths, expected):
    """Gaussians at the centre of an image of one pixel are doubtful if they are near a threshold."""
    means = [[0.0, 0.0, depth] for depth in depths]
    inputs = scenes.in_front_of_cameras(np.random.default_rng(0), (1, 1), means, 0.1, opacities)
    assert doubtful_pixels(scenes.settings((1, 1)), inputs, 5e-4).item() == expected


def test_close_calls_may_go_either_way_and_nothing_else():
    """A result with rounding errors and two close calls decided differently passes; with any other error it fails."""
    question = next(prepare_cases(["lpips_alex"], 1))
    calls = question.drawn.close_calls()
    otherwise = Evaluation(question.request, torch.float64, calls[1:3]).gradient_arrays(question.request.cotangents)
    rng = np.random.default_rng(0)
    answer = {
        name: (value * (1.0 + 1e-6 * rng.standard_normal(value.shape))).astype(np.float32)
        for name, value in (question.expected | otherwise).items()
    }
    assert not passes(answer, question.expected)
    expected, flipped = question.resolve_close_calls(answer)
    assert passes(answer, expected) and flipped == 2
    name = max(otherwise, key=lambda name: otherwise[name].size)
    wrong = answer | {name: answer[name] * np.float32(1.001)}
    assert not passes(wrong, question.resolve_close_calls(wrong)[0])
