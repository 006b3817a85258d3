"""Tests that TensorBoard's own reader finds the values of metrics.jsonl in a run's event files, each step once."""

import io
import json
import shutil
from itertools import pairwise

import numpy as np
import pytest
from command_line import make_rooms, succeed
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

SIZE, GAP = 32, 4
CONFIG = """
model = { latents = 16, width = 32, rgb_width = 32, ray_width = 16, rounds = 1, self_attention_blocks = 1, heads = 4, candidates = 4 }
curriculum = { final_stage = 2, boundaries = [2, 4], transition = 2 }
loss = { perceptual = "none", decoder_opacity = true }
train = { steps = 12, batch_size = 2, checkpoint_every = 4, validate_every = 4, log_every = 3, log_images_every = 5 }
[data]
captures = ["CAPTURES"]
image_size = [32, 32]
context_views = 3
target_views = 2
window = [3, 220]
holdout = "every:3+1"
"""
PROGRESS = ["loss", "psnr", "learning_rate", "gradient_norm", "stage", "mix", "samples_per_second"]
TERMS = ["mse", "perceptual", "consistency", "frustum", "decoder"]
PARTS = ["decoder_opacity", "decoder_scale", "decoder_rotation", "decoder_sh"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Returns a run that was killed after step 10, and then resumed from the checkpoint before step 8."""
    folder = tmp_path_factory.mktemp("tensorboard")
    make_rooms(folder / "captures", 1, 9, 40)
    (folder / "config.toml").write_text(CONFIG.replace("CAPTURES", str(folder / "captures")))
    train = ["train", "--config", folder / "config.toml", "--out", folder / "run"]
    succeed(*train, "--set", "train.steps=11", "--set", "train.checkpoint_every=4")
    shutil.rmtree(folder / "run/checkpoints/step-00000011")
    succeed(*train)
    return folder / "run"


@pytest.fixture(scope="module")
def events(run):
    # 0: keep all events
    return EventAccumulator(str(run / "tensorboard"), size_guidance={"scalars": 0, "images": 0}).Reload()


def test_every_start_has_a_file_of_its_own(run):
    names = sorted(path.name for path in (run / "tensorboard").iterdir())
    assert names == ["events.out.tfevents.0000000000", "events.out.tfevents.0000000001"]
    starts = []
    for name in names:
        found = list(EventFileLoader(str(run / "tensorboard" / name)).Load())
        assert found[0].file_version == "brain.Event:2"
        starts += [event.step for event in found if event.HasField("session_log")]
        assert all(a.wall_time <= b.wall_time for a, b in pairwise(found))
    assert starts == [0, 8]


def test_scalars_are_those_of_metrics_jsonl(run, events):
    logged = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    steps = [line for line in logged if "validation" not in line]
    assert [line["step"] for line in steps] == list(range(12))
    for line in steps:
        np.testing.assert_allclose(line["decoder"], 1e-2 * sum(line[part] for part in PARTS), rtol=1e-5)
        np.testing.assert_allclose(line["psnr"], -10 * np.log10(line["mse"]), rtol=1e-9)
        assert line["decoder_opacity"] > 0 and line["samples_per_second"] > 0
    validations = [line for line in logged if "validation" in line]

    expected = {f"train/{name}": [(step, steps[step][name]) for step in (0, 3, 6, 9)] for name in PROGRESS}
    expected |= {f"loss/{name}": [(step, steps[step][name]) for step in (0, 3, 6, 9)] for name in TERMS + PARTS}
    for name in ("psnr", "ssim", "stage"):
        expected[f"validation/{name}"] = [(line["step"], line["validation"][name]) for line in validations]
    assert [line["step"] for line in validations] == [3, 7, 11]
    assert set(events.Tags()["scalars"]) == set(expected)
    for tag, values in expected.items():
        found = [(event.step, event.value) for event in events.Scalars(tag)]
        np.testing.assert_allclose(found, values, rtol=1e-6, err_msg=tag)


def test_images_are_strips_of_five(events):
    assert events.Tags()["images"] == ["train/views"]
    images = events.Images("train/views")
    assert [image.step for image in images] == [0, 5, 10]
    rendered = []
    for image in images:
        decoded = np.asarray(Image.open(io.BytesIO(image.encoded_image_string)))
        assert decoded.shape == (image.height, image.width, 3) == (SIZE, 5 * SIZE + 4 * GAP, 3)
        photo, truth, render, depth, alpha = (decoded[:, i * (SIZE + GAP) : i * (SIZE + GAP) + SIZE] for i in range(5))
        assert photo.std() > 5 and truth.std() > 5 and not np.array_equal(photo, truth)
        assert (alpha == alpha[..., :1]).all(), "gray"
        rendered.append([render.any(), depth.any(), alpha.any()])
    # An untrained model renders some images black.
    assert np.any(rendered, axis=0).all()
