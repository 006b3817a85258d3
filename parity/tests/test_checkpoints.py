"""Tests of exchanging weights with Python: checkpoints of every layout that torch.save has had, and safetensors."""

import argparse
import collections
import datetime
import enum
import json
import os
import pathlib
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from rooms import make_rooms
from safetensors import safe_open
from safetensors.torch import load_file, save_file

REPOSITORY = Path(__file__).resolve().parents[2]
PROGRAM = REPOSITORY / "target/release/globalsplat"
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


def run(*arguments):
    return subprocess.run([PROGRAM, *map(str, arguments)], capture_output=True, text=True)


def succeed(*arguments):
    done = run(*arguments, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def refuse(*arguments):
    done = run(*arguments)
    assert done.returncode == 2 and not done.stdout, (done.returncode, done.stderr)
    assert done.stderr.startswith("globalsplat: ") and done.stderr.count("\n") == 1, done.stderr
    return done.stderr


def made(folder, **changes):
    """Exports a model with the program and returns its file. The configuration is MODEL with `changes`."""
    settings = {**MODEL, **changes.pop("model", {})}
    lines = [f"{key} = {json.dumps(value)}" for key, value in settings.items()]
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


def imported(file, out, *more):
    told = succeed("import", "--from", file, "--out", out, *more)
    return load_file(out), told


def configuration(file):
    return json.loads(run("inspect", file, "--json").stdout)["configuration"]


@dataclass
class Settings:
    """Example of a user's settings class that is pickled in a checkpoint."""

    learning_rate: float
    name: str


class Mode(enum.Enum):
    TRAIN = 1


def lightning(weights, prefix="model."):
    """Returns a checkpoint like Lightning's, which also has the frozen networks of a loss."""
    generator = torch.Generator().manual_seed(0)
    state = {prefix + name: tensor for name, tensor in weights.items()}
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
    read, told = imported(file, tmp_path / "model.safetensors")
    assert same(read, weights)
    # Frozen networks, and another tensor that isn't part of the model.
    assert told["left_out"] == 4
    text = configuration(tmp_path / "model.safetensors")
    assert all(f"{key} = {value}" in text for key, value in MODEL.items()), text
    assert "final_stage = 1" in text
    assert "4 attention heads" in told["taken_for"] and "don't tell" not in told["taken_for"]


@pytest.mark.parametrize("prefix", ["", "module.model.", "model._orig_mod.", "net.inner."])
def test_names_are_found_behind_any_prefix(weights, tmp_path, prefix):
    file = tmp_path / "model.pt"
    torch.save({prefix + name: tensor for name, tensor in weights.items()}, file)
    read, told = imported(file, tmp_path / "model.safetensors", "--set", "model.heads=4")
    assert same(read, weights) and told["left_out"] == 0


def test_the_model_is_preferred_to_its_moving_average(weights, tmp_path):
    file = tmp_path / "model.ckpt"
    average = {f"ema.{name}": torch.zeros_like(tensor) for name, tensor in weights.items()}
    torch.save({"state_dict": {**average, **{f"model.{k}": v for k, v in weights.items()}}}, file)
    read, told = imported(file, tmp_path / "model.safetensors")
    assert same(read, weights) and told["left_out"] == len(average)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_other_precisions_become_float32(weights, tmp_path, dtype):
    file = tmp_path / "model.pt"
    torch.save({name: tensor.to(dtype) for name, tensor in weights.items()}, file)
    read, _ = imported(file, tmp_path / "model.safetensors")
    assert same(read, {name: tensor.to(dtype).float() for name, tensor in weights.items()})


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
    file = tmp_path / "model.pt"
    torch.save(state, file)
    read, _ = imported(file, tmp_path / "model.safetensors")
    assert same(read, weights)


@pytest.mark.parametrize("change", [{"streams": "single"}, {"camera_code": False}, {"sh_degree": 0, "candidates": 8}])
def test_the_model_configuration_is_inferred_from_shapes(tmp_path, change):
    ours = made(tmp_path, model=change)
    torch.save({f"model.{name}": tensor for name, tensor in load_file(ours).items()}, tmp_path / "model.ckpt")
    succeed("import", "--from", tmp_path / "model.ckpt", "--out", tmp_path / "copy.safetensors")
    ours, theirs = (configuration(f).partition("[data]")[0] for f in [ours, tmp_path / "copy.safetensors"])
    assert ours == theirs and "[model]" in ours


def test_commands_take_checkpoints(weights, tmp_path):
    make_rooms(tmp_path, 1, 6, 32)
    torch.save(lightning(weights), tmp_path / "last.ckpt")
    imported(tmp_path / "last.ckpt", tmp_path / "model.safetensors")
    room, splats = tmp_path / "room_000", []
    for name in ["last.ckpt", "model.safetensors"]:
        out = tmp_path / f"{name}.ply"
        done = run("reconstruct", "--weights", tmp_path / name, "--scene", room, "--views", 2, "--out", out)
        assert done.returncode == 0, done.stderr
        splats.append(out.read_bytes())
        pictures = tmp_path / f"pictures of {name}"
        succeed("render", "--weights", tmp_path / name, "--scene", room, "--out", pictures)
        splats.append([file.read_bytes() for file in sorted(pictures.rglob("*.png"))])
        assert len(splats[-1]) == 6
        scores = succeed("eval", "--weights", tmp_path / name, "--scene", room, "--holdout", "every:3")
        splats.append(scores["psnr"])
    assert splats[:3] == splats[3:]
    assert "taken for" in run("eval", "--weights", tmp_path / "last.ckpt", "--scene", room).stderr


@pytest.mark.parametrize("dtype", ["f32", "bf16"])
def test_torch_loads_what_export_writes(model, weights, tmp_path, dtype):
    file = tmp_path / "model.ckpt"
    config = model.with_name("config.toml")
    succeed("export", "--config", config, "--format", "torch", "--out", file, "--dtype", dtype)
    kind = {"f32": torch.float32, "bf16": torch.bfloat16}[dtype]
    for mmap in [False, True]:
        checkpoint = torch.load(file, weights_only=True, mmap=mmap)
        state = checkpoint["state_dict"]
        assert isinstance(state, collections.OrderedDict)
        assert same(
            {n.removeprefix("model."): t for n, t in state.items()}, {n: t.to(kind) for n, t in weights.items()}
        )
        assert all(name.startswith("model.") for name in state)
    assert (checkpoint["epoch"], checkpoint["global_step"]) == (0, 0)
    # A module with the same parameters loads them with strict=True.
    module = torch.nn.Module()
    for name, tensor in weights.items():
        *path, last = name.split(".")
        inner = module
        for part in path:
            if not hasattr(inner, part):
                inner.add_module(part, torch.nn.Module())
            inner = getattr(inner, part)
        inner.register_parameter(last, torch.nn.Parameter(torch.empty_like(tensor)))
    holder = torch.nn.Module()
    holder.model = module
    holder.load_state_dict(state, strict=True)
    # Import it again, with the configuration that the checkpoint contains.
    read, told = imported(file, tmp_path / "back.safetensors")
    assert same(read, {n: t.to(kind).float() for n, t in weights.items()})
    assert told["taken_for"] is None and configuration(tmp_path / "back.safetensors") == configuration(model)


def test_safetensors_cross_both_ways(model, weights, tmp_path):
    with safe_open(model, "pt") as file:
        metadata = file.metadata()
    assert metadata["globalsplat.config"] == configuration(model)
    assert metadata["globalsplat.version"].count(".") == 2 and metadata["format"] == "pt"
    save_file(weights, tmp_path / "python.safetensors", metadata)
    save_file({f"model.{n}": t.half() for n, t in weights.items()}, tmp_path / "bare.safetensors")
    read, told = imported(tmp_path / "python.safetensors", tmp_path / "a.safetensors")
    assert same(read, weights) and told["taken_for"] is None
    read, told = imported(tmp_path / "bare.safetensors", tmp_path / "b.safetensors")
    assert same(read, {n: t.half().float() for n, t in weights.items()}) and told["taken_for"]


class Runs:
    """Object that makes Python call a function when it is unpickled."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol, place", [(2, "beside"), (4, "inside"), (4, "as a parameter")])
def test_what_would_run_code_is_refused_and_not_run(weights, tmp_path, protocol, place):
    trap = tmp_path / "trap"
    calls = {
        "system": Runs(os.system, f"touch {trap}"),
        "eval": Runs(eval, f"open({str(trap)!r}, 'w')"),
        "open": Runs(open, str(trap), "w"),
        "run": Runs(subprocess.run, ["touch", str(trap)]),
        "getattr": Runs(getattr, pathlib.Path("x"), "touch"),
    }
    for name, evil in calls.items():
        state = dict(weights)
        checkpoint = {"state_dict": state}
        if place == "beside":
            checkpoint["hyper_parameters"] = {"a": [evil]}
        elif place == "inside":
            state["evil"] = evil
        else:
            state["scene_tokens"] = evil
        file = tmp_path / "evil.ckpt"
        torch.save(checkpoint, file, pickle_protocol=protocol)
        error = refuse("import", "--from", file, "--out", tmp_path / "model.safetensors")
        assert f".{name}," in error and "nothing was run" in error, error
    assert "nothing was run" in refuse("reconstruct", "--weights", file, "--scene", "x", "--out", tmp_path / "a.ply")
    assert not trap.exists() and not (tmp_path / "model.safetensors").exists()


def test_files_that_are_cut_short_are_refused(weights, tmp_path):
    whole, cut = tmp_path / "whole.ckpt", tmp_path / "cut.ckpt"
    torch.save(lightning(weights), whole)
    contents = whole.read_bytes()
    for length in [0, 1, 3, 4, 20, 1000, *range(5000, len(contents), len(contents) // 12), len(contents) - 1]:
        cut.write_bytes(contents[:length])
        assert "cut.ckpt" in refuse("import", "--from", cut, "--out", tmp_path / "model.safetensors")


def test_damage_in_a_zip_is_noticed(weights, tmp_path):
    file = tmp_path / "model.ckpt"
    torch.save(lightning(weights), file)
    contents = bytearray(file.read_bytes())
    contents[len(contents) // 2] ^= 1
    file.write_bytes(contents)
    assert "checksum" in refuse("import", "--from", file, "--out", tmp_path / "model.safetensors")


def test_files_without_a_model_are_refused(weights, tmp_path):
    file, out = tmp_path / "model.ckpt", tmp_path / "out.safetensors"

    def refusal(contents):
        torch.save(contents, file)
        return refuse("import", "--from", file, "--out", out)

    def changed(name, change):
        return {**weights, name: change(weights[name])}

    gate, sh = "gaussian_decoder.gate_readout.weight", "gaussian_decoder.sh_readout.weight"
    assert "tensor scene_tokens is missing" in refusal({"state_dict": {"model.a": torch.zeros(3)}})
    assert "a dict without tensors" in refusal({"state_dict": {}})
    assert "a list" in refusal([torch.zeros(3)])
    assert f"tensor {sh} is [48, 20]" in refusal(changed(gate, lambda t: t[:3]))
    assert f"tensor {gate} is missing" in refusal({n: t for n, t in weights.items() if n != gate})
    assert "scene_tokens is [120]" in refusal(changed("scene_tokens", torch.flatten))
    assert "rgb_patch_embeds.1.weight is [12, 100]" in refusal(
        changed("rgb_patch_embeds.1.weight", lambda t: t[:, :100])
    )
    strange = "slot_encoder.geo_rounds.0.mlp.0.weight"
    error = refusal(changed(strange, lambda t: t.T.contiguous()))
    assert f"tensor {strange} is [20, 80], expected [80, 20]" in error
    error = refusal({**weights, "slot_encoder.extra": torch.zeros(2)})
    assert "slot_encoder.extra is [2], expected no such tensor" in error
    three = {**changed(gate, lambda t: t[:3]), sh: weights[sh][:36]}
    assert "model.candidates is 3" in refusal(three)
    endless = torch.zeros(1).expand(2**40)
    assert "scene_tokens" in refusal({**weights, "scene_tokens": endless})
    torch.save(weights, file)
    for setting, found in [("model.heads=3", "heads"), ("model.patch_size=4", "patch_embeds"), ("model.x=1", "x")]:
        assert found in refuse("import", "--from", file, "--out", out, "--set", setting)
    assert not out.exists()
