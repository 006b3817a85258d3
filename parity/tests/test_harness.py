"""Tests of the harness without the program: the reference takes its place, or results are constructed by hand."""

import dataclasses
import json
import re
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from parity import run
from parity.harness import coverage, draw, exchange, scenes
from parity.harness.areas import CASES
from parity.harness.close_calls import closest, decisions_of_lpips
from parity.harness.compare import compare, compare_tensor
from parity.harness.document import format_document
from parity.harness.evaluate import Evaluation, answer_files
from parity.harness.perturb import find_undetected
from parity.harness.runner import generator, prepare_cases, run_cases
from parity.harness.table import as_json, table
from parity.harness.thresholds import doubtful_pixels
from parity.harness.tolerance import FLOAT32, FLOAT64, Tolerance
from parity.reference.loss.lpips import convolutions

REPOSITORY = Path(__file__).resolve().parents[2]
torch.set_num_threads(1)

# Cases that are too slow for a test, or for which the reference in float32 is too inaccurate: its determinant suffers
# from cancellation for Gaussians that are hundreds of times longer than wide.
LEFT_OUT = {"model_16k", "projection_thin_float32", "rasterizer_thin_float32"}


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


# ---- comparison ------------------------------------------------------------------------------------------------------


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


def test_rounding_of_a_zero_gradient_is_held_by_the_largest_gradient():
    expected = {"grad.param.mem_k.bias": np.full(3, 1e-8), "grad.param.weight": np.full(3, 10.0)}
    for residue, fine in [(-3e-8, True), (1e-5, True), (1e-3, False)]:
        assert passes(expected | {"grad.param.mem_k.bias": np.full(3, residue)}, expected) == fine


def test_pictures_are_compared_by_their_largest_difference_where_rounding_does_not_decide():
    tolerance = Tolerance(1e-5, 1e-4, pictures=1e-4)
    expected = {"out.rgb": np.full((1, 1, 3, 2, 2), 0.9), "out.alpha": np.full((1, 1, 2, 2), 0.9)}
    wrong = {name: value.copy() for name, value in expected.items()}
    wrong["out.rgb"][..., 0, 1] += 2e-4
    wrong["out.alpha"][..., 0, 1] += 2e-4
    at, elsewhere = np.zeros((2, 1, 1, 2, 2), bool)
    at[..., 0, 1] = elsewhere[..., 1, 1] = True
    assert passes(wrong, expected, tolerance, doubtful=at)
    assert not passes(wrong, expected, tolerance, doubtful=elsewhere)
    dim = np.full((1, 1, 2, 2), 1e-2)  # a hundredth of the brightness has a hundredth of the tolerance
    assert not compare_tensor("out.alpha", dim + 2e-6, dim, tolerance, 0.0).passed


# ---- self-test -------------------------------------------------------------------------------------------------------


def test_every_perturbation_of_a_correct_answer_is_detected():
    tried, missed = find_undetected(canned(), canned(), FLOAT32)
    assert tried > 15 and missed == []


def test_a_comparison_that_excludes_all_pixels_is_detected():
    """If all pixels are excluded, images with any values pass."""
    pictures = {"out.alpha": np.full((1, 1, 2, 3), 0.5)}
    tried, missed = find_undetected(pictures, pictures, FLOAT32, np.ones((1, 1, 2, 3), bool))
    assert "out.alpha: times 1.001" in missed and "out.alpha: slice 0 of axis 2 dropped" in missed
    assert len(missed) == tried - 2  # all except "left out" and "not a number"


# ---- exchange --------------------------------------------------------------------------------------------------------


def test_a_request_survives_its_file(tmp_path):
    request = exchange.Request(
        "merge",
        {"stage": 1, "mix": 0.3, "image": [2, 3]},
        params={"layer.weight": np.float32([[1, 2], [3, 4]]).T},
        inputs={"xs": np.zeros((0, 3)), "steps": np.array([1, 2])},
        cotangents={"loss": np.ones(1, np.float32)},
        differentiate=("xs",),
    )
    exchange.write_request(tmp_path / "a.npz", request)
    back = exchange.read_request(tmp_path / "a.npz")
    assert (back.module, back.config, back.differentiate) == ("merge", request.config, ("xs",))
    for group in ("params", "inputs", "cotangents"):
        ours, theirs = getattr(request, group), getattr(back, group)
        assert ours.keys() == theirs.keys()
        for name in ours:
            np.testing.assert_array_equal(ours[name], theirs[name], strict=True)
    with np.load(tmp_path / "a.npz") as file:  # properties that the program relies on
        assert set(file) == {"case", "param.layer.weight", "in.xs", "in.steps", "cot.loss"}
        assert file["case"].dtype == np.uint8 and file["param.layer.weight"].flags.c_contiguous


def test_an_answer_is_arrays_or_an_error(tmp_path):
    exchange.write_answer(tmp_path / "a.npz", {"out.loss": np.ones(1)})
    exchange.write_answer(tmp_path / "b.npz", {"error": exchange.text("there is no parity case ε")})
    assert exchange.read_answer(tmp_path / "a.npz")["out.loss"].tolist() == [1.0]
    assert exchange.read_answer(tmp_path / "b.npz") == {"error": "there is no parity case ε"}
    assert exchange.read_answer(tmp_path / "c.npz") == {"error": "no answer"}


# ---- cases -----------------------------------------------------------------------------------------------------------


def test_the_reference_in_float32_passes_every_case():
    """Tolerances are achievable in float32, so a program that fails is wrong."""
    names = [name for name in CASES if name not in LEFT_OUT]
    results = list(run_cases(names, 0, answer_files))
    assert {result.case for result in results} == CASES.keys() - LEFT_OUT
    assert [table([result]) for result in results if not result.passed] == []
    assert json.loads(json.dumps(as_json(results)))["passed"]


def test_a_case_is_drawn_the_same_alone_and_with_others():
    alone = next(prepare_cases(["mixer"], 3)).request
    for other, same in [
        (list(prepare_cases(["heads", "mixer"], 3))[4], True),
        (next(prepare_cases(["mixer"], 4)), False),
    ]:
        equal = [
            np.array_equal(value, getattr(other.request, group).get(name))
            for group in ("params", "inputs", "cotangents")
            for name, value in getattr(alone, group).items()
        ]
        assert all(equal) == same


def test_gradients_are_of_the_sum_of_cotangent_times_output():
    rng = np.random.default_rng(1)
    config = {"stage": 1, "mix": 0.3}
    tails = {"positions": (3,), "log_scales": (3,), "rotations": (6,), "opacity_logits": (1,), "sh": (3,), "gate": ()}
    inputs = {name: rng.standard_normal((1, 2, 4, *tail)) for name, tail in tails.items()}
    inputs["unused"] = np.zeros(3)
    request = exchange.Request("merge", config, inputs=inputs, differentiate=("gate", "unused"))
    evaluation = Evaluation(request, torch.float64)
    cotangents = {name: rng.standard_normal(value.shape) for name, value in evaluation.outputs.items()}
    gradient = evaluation.gradient_arrays(cotangents)
    assert gradient.keys() == {"grad.in.gate", "grad.in.unused"} and not gradient["grad.in.unused"].any()

    def objective(step):
        moved = inputs | {"gate": inputs["gate"].copy()}
        moved["gate"][0, 1, 2] += step
        outputs = Evaluation(exchange.Request("merge", config, inputs=moved), torch.float64).output_arrays()
        return sum((cotangents[name] * outputs[f"out.{name}"]).sum() for name in cotangents)

    slope = (objective(1e-5) - objective(-1e-5)) / 2e-5
    assert gradient["grad.in.gate"][0, 1, 2] == pytest.approx(slope, rel=1e-6)


def test_the_main_model_has_its_parameters():
    assert sum(int(np.prod(shape)) for shape in draw.shapes(draw.MAIN_16K).values()) == 84_321_120


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


def test_close_calls_of_lpips():
    """A value of 0 before a ReLU and equal maxima of a pooling window are close calls."""
    params = draw.lpips_parameters(np.random.default_rng(0), "lpips_alex")
    pictures = draw.uniform(np.random.default_rng(1), 0.0, 1.0, 1, 3, 31, 31)

    def closest_of(params, pictures):
        return closest(decisions_of_lpips("lpips_alex", params, [pictures]))

    sure = closest_of(params, pictures)
    assert sure > 0.0
    found = convolutions("lpips_alex", {k: torch.tensor(v) for k, v in params.items()}, torch.tensor(pictures))
    params["conv5.bias"][7] -= found["conv5"][0, 7].item()  # its only pixel becomes 0 up to rounding
    assert closest_of(params, pictures) < 1e-5 < sure
    flat = np.zeros_like(pictures)  # all values of a window are equal, except near the border
    assert closest_of(draw.lpips_parameters(np.random.default_rng(0), "lpips_alex"), flat) < 1e-12


@pytest.mark.parametrize(("case", "seed"), [("lpips_alex", 1), ("vgg19", 1)])
def test_close_calls_may_go_either_way_and_nothing_else(case, seed):
    """A result with rounding errors and two close calls decided differently passes; with any other error it fails."""
    question = next(prepare_cases([case], seed))
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


@pytest.mark.parametrize("case", ["perceptual", "lpips_alex"])
def test_close_calls_can_be_asked_for_once_all_draws_are_made(case):
    draws = list(CASES[case](generator(0, case)))
    assert sum(len(drawn.close_calls()) for drawn in draws) > 0


def test_every_module_has_a_case():
    assert coverage.gaps(REPOSITORY) == []
    assert sorted(name for names in coverage.CASES_OF.values() for name in names) == sorted(CASES)


# ---- the command -----------------------------------------------------------------------------------------------------

STAND_IN = """#!{python}
import sys
from pathlib import Path
import numpy as np
from parity.harness.evaluate import answer_files
from parity.harness.exchange import write_answer
options = dict(zip(sys.argv[2::2], sys.argv[3::2]))
requests, answers = Path(options["--requests"]), Path(options["--responses"])
answer_files(requests, answers)
{then}
"""


@pytest.fixture(autouse=True)
def parity_is_importable(monkeypatch):
    """Lets programs that tests start import this checkout's parity."""
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))


def stand_in(tmp_path, then):
    path = tmp_path / "program"
    path.write_text(STAND_IN.format(python=sys.executable, then=then))
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


SPOIL = """
for path in answers.iterdir():
    answer = dict(np.load(path))
    answer["out.loss"] = answer["out.loss"] * 1.01
    write_answer(path, answer)
"""


@pytest.mark.parametrize(
    "then, status, said", [("", 0, "2 draws, 0 failed"), (SPOIL, 1, "FAIL mse"), ("sys.exit('broken')", 1, "broken")]
)
def test_exit_status(tmp_path, capsys, then, status, said):
    report = tmp_path / "report.json"
    program = stand_in(tmp_path, then)
    assert run.main(["--only", "ms?", "--self-test", "--binary", str(program), "--json", str(report)]) == status
    captured = capsys.readouterr()
    assert said in captured.out + captured.err
    if then != "sys.exit('broken')":
        assert json.loads(report.read_text())["passed"] == (status == 0)


def test_a_sample_of_the_cases_is_self_tested(tmp_path):
    report = tmp_path / "report.json"
    requests = ["--only", "mse,resample,subsets", "--binary", str(stand_in(tmp_path, "")), "--json", str(report)]
    assert run.main([*requests, "--self-test", "1/2"]) == 0
    draws = json.loads(report.read_text())["draws"]
    names = sorted({draw["case"] for draw in draws}, key=list(CASES).index)
    assert len(names) == 3 and {draw["case"] for draw in draws if draw["disturbed"]} == {names[1]}


def test_the_document_has_results_but_no_paths(tmp_path, capsys):
    program, written = stand_in(tmp_path, ""), []
    for name in ("first", "second"):
        path = tmp_path / name / "parity.md"
        path.parent.mkdir()
        requests = ["--only", "ms?", "--seed", "1", "--self-test", "--markdown", str(path), "--binary", str(program)]
        assert run.main(requests) == 0
        written.append(path.read_text())
    assert written[0] == written[1] and str(tmp_path) not in written[0]
    said = capsys.readouterr().out
    tried = re.search(r"(\d+) perturbed", said)[1]
    words = " ".join(written[0].split())
    assert "2 draws of 1 case, none failed" in words and "at least 2 times the tolerance." in words
    assert f"Of {tried} perturbed results, all were rejected." in words
    assert "\n\n    python parity/run.py --only 'ms?' --seed 1 --self-test --markdown parity.md\n\n" in written[0]
    assert "| mse | 2 | " in written[0] and "## Tolerances" not in written[0] and "## Failures" not in written[0]


def test_document_describes_failures():
    def spoiled(requests, answers, on_progress):
        answer_files(requests, answers)
        for path in answers.iterdir():
            if "mse" in path.name:
                answer = dict(np.load(path))
                exchange.write_answer(path, answer | {"out.loss": answer["out.loss"] * np.float32(1.01)})

    names = ["mse", "resample", "subsets"]
    results = list(run_cases(names, 0, spoiled, self_test=names))
    text = format_document(results, "the command", "cpu")
    assert re.search(r"\| mse \| 2 \| \*\*1e-02 of 1e-05\*\* \|", text) and "\n- FAIL mse (seed 0), " in text
    assert "| subsets | 8 | exact |  |" in text and "- exact: " in text
    assert "\n- `resample`: results are rounded to 8 bits" in text
    missed = [dataclasses.replace(result, missed=["out.image: times 1.001"]) for result in results[-1:]]
    assert "1 were accepted:" in " ".join(format_document(missed, "the command", "cpu").split())
    unheld = [dataclasses.replace(result, tried=0) for result in results]
    assert "perturbed results" not in format_document(unheld, "the command", "cpu")


def test_wrong_requests(tmp_path, capsys):
    assert run.main(["--only", "nothing"]) == 2
    for sample in ("2/2", "-1/2", "1", "a/b"):
        with pytest.raises(SystemExit):
            run.main(["--only", "mse", "--self-test", sample])
    assert run.main(["--binary", str(tmp_path / "absent")]) == 2
    assert "absent" in capsys.readouterr().err
