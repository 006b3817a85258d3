"""Tests of files exchanged with Python: checkpoints of every layout that torch.save has had, safetensors, and chunks."""

import argparse
import collections
import datetime
import json
import pathlib
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
import torch
from command_line import make_rooms, refuse, run, succeed
from safetensors import safe_open
from safetensors.torch import load_file, save_file

# The number of heads differs from the default of eight, because shapes don't determine it.
MODEL = {
    "latents": 6,
    "width": 20,
    "rgb_width": 12,
    "ray_width": 8,
    "rounds": 2,
    "self_attention_blocks": 1,
    "heads": 4,
    "candidates": 4,
    "sh_degree": 1,
}


def made(folder, **changes):
    """Exports a model with the program and returns its file. The configuration is MODEL with `changes`."""
    lines = [f"{key} = {json.dumps(value)}" for key, value in (MODEL | changes).items()]
    config = folder / "config.toml"
    config.write_text("\n".join(["[model]", *lines, "[curriculum]", "final_stage = 1", ""]))
    succeed("export", "--config", config, "--out", folder / "model.safetensors")
    return folder / "model.safetensors"


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return made(tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="module")
def weights(model):
    return load_file(model)


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def imported(file, *more):
    """Returns the weights that the program makes of a file, and its report."""
    out = file.with_name(f"imported {file.stem}.safetensors")
    report = succeed("import", "--from", file, "--out", out, *more)
    return load_file(out), report


def configuration(file):
    with safe_open(file, "pt") as opened:
        return opened.metadata()["globalsplat.config"]


# ---- what is read ----------------------------------------------------------------------------------------------------


@dataclass
class Settings:
    """Example of a user's settings class that is pickled in a checkpoint."""

    learning_rate: float
    name: str


def lightning(weights):
    """Returns a checkpoint like Lightning's, which also has the frozen networks of a loss."""
    generator = torch.Generator().manual_seed(0)
    state = {f"model.{name}": tensor for name, tensor in weights.items()}
    frozen = {f"loss.vgg.features.{i}.weight": torch.randn(3, 3, generator=generator) for i in range(3)}
    parameter = torch.nn.Parameter(torch.zeros(3))
    optimizer = torch.optim.AdamW([parameter])
    parameter.sum().backward()
    optimizer.step()
    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1.0)
    return {
        "epoch": 3,
        "global_step": 2**40,
        "pytorch-lightning_version": "2.4.0",
        "state_dict": collections.OrderedDict([*frozen.items(), *state.items(), ("lpips.scale", torch.tensor(1))]),
        "optimizer_states": [optimizer.state_dict()],
        "lr_schedulers": [scheduler.state_dict()],
        "loops": {"fit_loop": {"state_dict": {}, "epoch_progress": {"total": {"ready": 1}}}},
        "callbacks": {
            "ModelCheckpoint{'monitor': 'psnr'}": {
                "best_model_score": torch.tensor(1.5),
                "dirpath": pathlib.PosixPath("/runs/one"),
                "best_k_models": {},
                "when": datetime.datetime(2026, 1, 2),
            }
        },
        "hparams_name": "hyper_parameters",
        "hyper_parameters": {
            "settings": Settings(1e-3, "a"),
            "model": argparse.Namespace(num_heads=MODEL["heads"], losses={"vgg", "mse"}),
            "array": np.arange(3.0),
            "scalar": np.float64(2),
            "device": torch.device("cpu"),
            "size": torch.Size([1, 2]),
            "dtype": torch.float16,
            "complex": torch.zeros(2, dtype=torch.complex64),
            "bytes": b"\x00\x01",
            "counts": collections.defaultdict(int, a=1),
            "long": 10**30,
            "nothing": None,
        },
    }


@pytest.mark.parametrize("protocol", [2, 5])
def test_checkpoints_of_lightning_are_read(weights, tmp_path, protocol):
    file = tmp_path / "last.ckpt"
    torch.save(lightning(weights), file, pickle_protocol=protocol)
    read, report = imported(file)
    assert same(read, weights)
    # Frozen networks, and another tensor that isn't part of the model.
    assert report["left_out"] == 4
    text = configuration(tmp_path / "imported last.safetensors")
    assert all(f"{key} = {value}" in text for key, value in MODEL.items()), text
    assert "final_stage = 1" in text
    assert "4 attention heads" in report["taken_for"] and "don't tell" not in report["taken_for"]


def test_a_checkpoint_serves_as_weights(weights, tmp_path):
    make_rooms(tmp_path, 1, 2, 32)
    torch.save(lightning(weights), tmp_path / "last.ckpt")
    imported(tmp_path / "last.ckpt")
    splats = []
    for file in ["last.ckpt", "imported last.safetensors"]:
        out = tmp_path / f"{file}.ply"
        done = run("reconstruct", "--weights", tmp_path / file, "--scene", tmp_path / "room_000", "--out", out)
        assert done.returncode == 0 and ("taken for" in done.stderr) == (file == "last.ckpt"), done.stderr
        splats.append(out.read_bytes())
    assert splats[0] == splats[1]


@pytest.mark.parametrize(
    "prefix, dtype",
    [
        ("", torch.float16),
        ("module.model.", torch.bfloat16),
        ("model._orig_mod.", torch.float64),
        ("net.inner.", torch.float32),
    ],
)
def test_names_behind_any_prefix_and_any_precision_are_read(weights, tmp_path, prefix, dtype):
    torch.save({prefix + name: tensor.to(dtype) for name, tensor in weights.items()}, tmp_path / "model.pt")
    read, report = imported(tmp_path / "model.pt", "--set", "model.heads=4")
    assert same(read, {name: tensor.to(dtype).float() for name, tensor in weights.items()}) and report["left_out"] == 0


def test_the_model_is_preferred_to_its_moving_average(weights, tmp_path):
    average = {f"ema.{name}": torch.zeros_like(tensor) for name, tensor in weights.items()}
    torch.save({"state_dict": {**average, **{f"model.{k}": v for k, v in weights.items()}}}, tmp_path / "model.ckpt")
    read, report = imported(tmp_path / "model.ckpt")
    assert same(read, weights) and report["left_out"] == len(average)


def test_shared_storages_and_any_strides_are_read(weights, tmp_path):
    flat = torch.cat([tensor.flatten() for tensor in weights.values()])
    state, offset = {}, 0
    for name, tensor in weights.items():
        state[name] = flat[offset : offset + tensor.numel()].view(tensor.shape)
        offset += tensor.numel()
        if "mlp" in name and tensor.dim() == 2:
            state[name] = tensor.T.contiguous().T
            assert not state[name].is_contiguous()
    state = {name: torch.nn.Parameter(tensor) for name, tensor in state.items()}
    state["twice"] = state["scene_tokens"]
    # With attributes, torch.save pickles parameters and tensors differently.
    state["slot_encoder.scale_emb"].tag = "a parameter"
    state["slot_encoder.mem_regs"] = weights["slot_encoder.mem_regs"].clone()
    state["slot_encoder.mem_regs"].tag = "a tensor"
    torch.save(state, tmp_path / "model.pt")
    assert same(imported(tmp_path / "model.pt")[0], weights)


def test_the_model_configuration_is_inferred_from_shapes(tmp_path):
    ours = made(tmp_path, streams="single", camera_code=False, sh_degree=0, candidates=8)
    torch.save({f"model.{name}": tensor for name, tensor in load_file(ours).items()}, tmp_path / "copy.ckpt")
    imported(tmp_path / "copy.ckpt")
    ours, theirs = (
        configuration(file).partition("[data]")[0] for file in [ours, tmp_path / "imported copy.safetensors"]
    )
    assert ours == theirs and "[model]" in ours


@pytest.mark.parametrize("dtype", ["f32", "bf16"])
def test_torch_loads_what_export_writes(model, weights, tmp_path, dtype):
    file, config = tmp_path / "model.ckpt", model.with_name("config.toml")
    succeed("export", "--config", config, "--format", "torch", "--out", file, "--dtype", dtype)
    rounded = {name: t.to({"f32": torch.float32, "bf16": torch.bfloat16}[dtype]) for name, t in weights.items()}
    for mmap in [False, True]:
        checkpoint = torch.load(file, weights_only=True, mmap=mmap)
        state = checkpoint["state_dict"]
        assert isinstance(state, collections.OrderedDict)
        assert same(state, {f"model.{name}": tensor for name, tensor in rounded.items()})
    assert (checkpoint["epoch"], checkpoint["global_step"]) == (0, 0)
    # Import it again, with the configuration that the checkpoint contains.
    read, report = imported(file)
    assert same(read, {name: tensor.float() for name, tensor in rounded.items()}) and report["taken_for"] is None
    assert configuration(tmp_path / "imported model.safetensors") == configuration(model)


def test_safetensors_cross_both_ways(model, weights, tmp_path):
    with safe_open(model, "pt") as file:
        metadata = file.metadata()
    assert metadata["globalsplat.version"].count(".") == 2 and metadata["format"] == "pt"
    save_file(weights, tmp_path / "python.safetensors", metadata)
    save_file({f"model.{n}": t.half() for n, t in weights.items()}, tmp_path / "bare.safetensors")
    read, report = imported(tmp_path / "python.safetensors")
    assert same(read, weights) and report["taken_for"] is None
    read, report = imported(tmp_path / "bare.safetensors")
    assert same(read, {n: t.half().float() for n, t in weights.items()}) and report["taken_for"]


# ---- what is refused. Files that are damaged or would run code are cases of crates/torch-file. --------------------------


def test_files_without_a_model_are_refused(weights, tmp_path):
    file, out = tmp_path / "model.ckpt", tmp_path / "out.safetensors"
    gate, sh = "gaussian_decoder.gate_readout.weight", "gaussian_decoder.sh_readout.weight"
    rgb, mlp = "rgb_patch_embeds.1.weight", "slot_encoder.geo_rounds.0.mlp.0.weight"
    for contents, expected in [
        ({"state_dict": {"model.a": torch.zeros(3)}}, "tensor scene_tokens is missing"),
        ({"state_dict": {}}, "a dict without tensors"),
        ([torch.zeros(3)], "a list"),
        ({gate: weights[gate][:3]}, f"tensor {sh} is [48, 20]"),
        ({gate: None}, f"tensor {gate} is missing"),
        ({"scene_tokens": weights["scene_tokens"].flatten()}, "scene_tokens is [120]"),
        ({"scene_tokens": torch.zeros(1).expand(2**40)}, "scene_tokens"),
        ({rgb: weights[rgb][:, :100]}, f"{rgb} is [12, 100]"),
        ({mlp: weights[mlp].T.contiguous()}, f"tensor {mlp} is [20, 80], expected [80, 20]"),
        ({"slot_encoder.extra": torch.zeros(2)}, "slot_encoder.extra is [2], expected no such tensor"),
        ({gate: weights[gate][:3], sh: weights[sh][:36]}, "model.candidates is 3"),
    ]:
        if isinstance(contents, dict) and "state_dict" not in contents:
            contents = {name: tensor for name, tensor in (weights | contents).items() if tensor is not None}
        torch.save(contents, file)
        error = refuse("import", "--from", file, "--out", out)
        assert expected in error, error
    torch.save(weights, file)
    for setting, found in [("model.heads=3", "heads"), ("model.patch_size=4", "patch_embeds"), ("model.x=1", "x")]:
        assert found in refuse("import", "--from", file, "--out", out, "--set", setting)
    assert not out.exists()


# ---- chunks ----------------------------------------------------------------------------------------------------------


def bytes_of(image):
    return image.numpy().tobytes()


def test_chunks_cross_both_ways(tmp_path):
    make_rooms(tmp_path, 1, 5, 24)
    room, packed = tmp_path / "room_000", tmp_path / "chunks"
    assert run("pack", room, "--out", packed).returncode == 0
    assert json.loads((packed / "index.json").read_text()) == {"room_000": "000000.torch"}
    [scene] = torch.load(packed / "000000.torch", weights_only=True)
    types = {"key": str, "url": str, "timestamps": torch.Tensor, "cameras": torch.Tensor, "images": list}
    assert {key: type(value) for key, value in scene.items()} == types
    assert scene["key"] == "room_000" and scene["timestamps"].tolist() == list(range(5))
    photos = [path.read_bytes() for path in sorted((room / "images").iterdir())]
    assert [bytes_of(image) for image in scene["images"]] == photos
    capture = json.loads((room / "cameras.json").read_text())
    assert scene["cameras"].dtype == torch.float32 and scene["cameras"].shape == (5, 18)
    for numbers, view in zip(scene["cameras"].double().numpy(), capture["views"], strict=True):
        k = np.array(view["intrinsic"]) / 24
        np.testing.assert_allclose(numbers[:6], [k[0, 0], k[1, 1], k[0, 2], k[1, 2], 0, 0], atol=1e-6)
        np.testing.assert_allclose(numbers[6:].reshape(3, 4), np.linalg.inv(view["c2w"])[:3], atol=1e-6)

    # Layouts that occur in datasets: slices of larger tensors, shared tensors, more scenes than one batch of the
    # pickler.
    video = torch.cat(scene["images"])
    offsets = np.cumsum([0, *(len(image) for image in scene["images"])])
    sliced = dict(scene, key="sliced", images=[video[a:b] for a, b in pairwise(offsets)])
    shared = dict(scene, key="shared", url="https://example.org/é")
    many = [dict(scene, key=f"scene_{i}") for i in range(1100)]
    torch.save([scene, sliced, shared, *many], tmp_path / "python.torch")

    seen = succeed("inspect", tmp_path / "python.torch")
    assert seen["scenes"] == 1103 and set(seen["views"].values()) == {5}
    for key in ["sliced", "shared", "scene_1099"]:
        assert run("pack", f"{tmp_path / 'python.torch'}#{key}", "--out", tmp_path / key).returncode == 0
        [copy] = torch.load(tmp_path / key / "000000.torch")
        assert [bytes_of(image) for image in copy["images"]] == photos
        torch.testing.assert_close(copy["cameras"], scene["cameras"], atol=1e-6, rtol=0)
