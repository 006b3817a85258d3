"""Tests that third-party programs read the splats that our program writes, in every format, and vice versa.

Values must be equal up to each format's quantization. The programs are pinned in parity/npm, and installed by `npm ci`.
"""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PROGRAM = REPOSITORY / "target/release/globalsplat"
NPM = REPOSITORY / "parity/npm"
COUNT = 300  # more than a chunk of a compressed PLY
C0 = 0.28209479177387814
# Half of each format's quantization step: positions, logarithms of scales, rotations, opacities, colours, coefficients.
STEPS = {
    "ply": (1e-6, 1e-5, 1e-5, 1e-5, 1e-6, 1e-6),
    "compressed.ply": (4.1 / 1023, 1.1 / 1023, 0.003, 0.51 / 255, 1 / 255, 0.51 / 32),
    "spz": (1e-6, 0.51 / 16, 0.003, 0.51 / 255, 0.51 / 255 / 0.15, 0.51 / 64),
    # Niantic's library uses 12 fractional bits for positions, and rounds coefficients to 8 bits, then to 5 and 4 of
    # them; version 2 has 8 bits per component of a rotation.
    "their spz": (0.51 / 4096, 0.51 / 16, 0.003, 0.51 / 255, 0.51 / 255 / 0.15, 8.51 / 128),
    "spz of version 2": (0.51 / 4096, 0.51 / 16, 0.12, 0.51 / 255, 0.51 / 255 / 0.15, 8.51 / 128),
    "splat": (1e-6, 1e-5, 0.02, 0.51 / 255, 0.51 / 255 / C0, 0),
}


@pytest.fixture(autouse=True, scope="module")
def _programs():
    if shutil.which("node") is None:
        pytest.skip("Node.js: nothing reads our splats but ourselves")
    if not (NPM / "node_modules").is_dir():
        pytest.skip("Node.js packages: parity/npm/node_modules isn't there; npm ci makes it")


def made(degree):
    """Returns a random splat that every format can represent, with a PLY's properties.

    These are opacity logits, logarithms of scales, and channel-major coefficients.
    """
    random = np.random.default_rng(degree)
    names = ["x", "y", "z", *(f"f_dc_{k}" for k in range(3))]
    names += [f"f_rest_{k}" for k in range(3 * ((degree + 1) ** 2 - 1))]
    names += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    splat = {name: random.uniform(-0.9, 0.9, COUNT) for name in names}
    for name in "xyz":
        splat[name] *= 4
    for k in range(3):
        splat[f"scale_{k}"] -= 3
    return {name: values.astype("<f4") for name, values in splat.items()}


def write_ply(path, splat):
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {COUNT}"]
    lines += [f"property float {name}" for name in splat]
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + np.stack([*splat.values()], 1).tobytes())


def read_ply(path):
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property float")]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names))
    return {name: rows[:, column] for column, name in enumerate(names)}


def columns(splat, *names):
    return np.stack([splat[name].astype(np.float64) for name in names], 1)


def rest(splat):
    names = [name for name in splat if name.startswith("f_rest_")]
    return columns(splat, *(f"f_rest_{k}" for k in range(len(names)))) if names else np.zeros((len(splat["x"]), 0))


def assert_same(splat, other, steps):
    """Asserts that two splats are equal up to `steps`, in any order: each Gaussian is compared with the nearest one."""
    places, others = columns(splat, *"xyz"), columns(other, *"xyz")
    nearest = ((places[:, None] - others) ** 2).sum(-1).argmin(1)
    assert len(others) == COUNT and len(set(nearest)) == COUNT
    other = {name: values[nearest] for name, values in other.items()}
    scales, colours = [[f"{name}_{k}" for k in range(3)] for name in ("scale", "f_dc")]
    turns = [columns(one, *(f"rot_{k}" for k in range(4))) for one in (splat, other)]
    turns = [turn / np.linalg.norm(turn, axis=1, keepdims=True) for turn in turns]
    turns[1] *= np.sign((turns[0] * turns[1]).sum(1, keepdims=True))  # q and −q are the same rotation
    opacities = [1 / (1 + np.exp(-one["opacity"].astype(np.float64))) for one in (splat, other)]
    for what, a, b, step in [
        ("positions", places, others[nearest], steps[0]),
        ("scales", columns(splat, *scales), columns(other, *scales), steps[1]),
        ("rotations", *turns, steps[2]),
        ("opacities", *opacities, steps[3]),
        ("colours", columns(splat, *colours), columns(other, *colours), steps[4]),
        ("coefficients", rest(splat), rest(other), steps[5]),
    ]:
        np.testing.assert_allclose(b, a, rtol=0, atol=step, err_msg=what)


def run(*command):
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def ours(source, target, *options):
    run(PROGRAM, "convert", source, target, *options)


def transformed(source, target, *options):
    """Converts a splat with PlayCanvas' splat-transform."""
    run("node", NPM / "node_modules/@playcanvas/splat-transform/bin/cli.mjs", "-q", "-w", source, target, *options)


def cloud(splat):
    """Converts a splat to the layout of Niantic's library: basis-major coefficients, real part of a rotation last."""
    count = rest(splat).shape[1]
    turns = columns(splat, "rot_1", "rot_2", "rot_3", "rot_0")
    return {
        "numPoints": COUNT,
        "shDegree": [0, 9, 24, 45].index(count),
        "antialiased": False,
        "positions": columns(splat, *"xyz").ravel().tolist(),
        "scales": columns(splat, *(f"scale_{k}" for k in range(3))).ravel().tolist(),
        "rotations": (turns / np.linalg.norm(turns, axis=1, keepdims=True)).ravel().tolist(),
        "alphas": splat["opacity"].astype(np.float64).tolist(),
        "colors": columns(splat, *(f"f_dc_{k}" for k in range(3))).ravel().tolist(),
        "sh": rest(splat).reshape(COUNT, 3, -1).swapaxes(1, 2).ravel().tolist(),
    }


def splat_of(cloud):
    count = cloud["numPoints"]
    three = {name: np.array(cloud[name]).reshape(count, 3) for name in ("positions", "scales", "colors")}
    turns = np.array(cloud["rotations"]).reshape(count, 4)
    sh = np.array(cloud["sh"]).reshape(count, -1, 3).swapaxes(1, 2).reshape(count, -1)
    splat = {name: three["positions"][:, k] for k, name in enumerate("xyz")}
    splat |= {f"f_dc_{k}": three["colors"][:, k] for k in range(3)}
    splat |= {f"f_rest_{k}": sh[:, k] for k in range(sh.shape[1])}
    splat |= {"opacity": np.array(cloud["alphas"])}
    splat |= {f"scale_{k}": three["scales"][:, k] for k in range(3)}
    return splat | {f"rot_{k}": turns[:, (k - 1) % 4] for k in range(4)}


def read_by(program, file, folder):
    run("node", NPM / "splats.mjs", "read", program, file, folder / "numbers.json")
    return splat_of(json.loads((folder / "numbers.json").read_text()))


def write_by(program, splat, file, folder, *version, antialiased=False):
    (folder / "numbers.json").write_text(json.dumps(cloud(splat) | {"antialiased": antialiased}))
    run("node", NPM / "splats.mjs", "write", program, folder / "numbers.json", file, *version)


def without_sh(splat):
    return {name: values for name, values in splat.items() if not name.startswith("f_rest_")}


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("ending", ["ply", "compressed.ply", "spz", "splat"])
def test_splat_transform_reads_ours(tmp_path, ending, degree):
    splat = made(degree)
    write_ply(tmp_path / "a.ply", splat)
    ours(tmp_path / "a.ply", tmp_path / f"b.{ending}")
    transformed(tmp_path / f"b.{ending}", tmp_path / "c.ply")
    expected = without_sh(splat) if ending == "splat" else splat
    assert_same(expected, read_ply(tmp_path / "c.ply"), STEPS[ending])


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("ending, options", [("ply", []), ("compressed.ply", []), ("spz", ["3"]), ("spz", ["4"])])
def test_we_read_splat_transforms(tmp_path, ending, options, degree):
    splat = made(degree)
    write_ply(tmp_path / "a.ply", splat)
    version = [word for number in options for word in ("--spz-version", number)]
    transformed(tmp_path / "a.ply", tmp_path / f"b.{ending}", *version)
    ours(tmp_path / f"b.{ending}", tmp_path / "c.ply")
    assert_same(splat, read_ply(tmp_path / "c.ply"), STEPS["their spz" if ending == "spz" else ending])


@pytest.mark.parametrize("degree", range(4))
def test_niantics_library_reads_and_writes_as_we_do(tmp_path, degree):
    splat = made(degree)
    write_ply(tmp_path / "a.ply", splat)
    ours(tmp_path / "a.ply", tmp_path / "a.spz")
    assert_same(splat, read_by("adobe", tmp_path / "a.spz", tmp_path), STEPS["spz"])
    for version in "234":
        write_by("adobe", splat, tmp_path / "b.spz", tmp_path, version)
        ours(tmp_path / "b.spz", tmp_path / "c.ply")
        expected = STEPS["spz of version 2" if version == "2" else "their spz"]
        assert_same(splat, read_ply(tmp_path / "c.ply"), expected)


def test_niantics_library_and_we_mark_antialiased_splats_alike(tmp_path):
    write_ply(tmp_path / "plain.ply", made(1))
    plain = (tmp_path / "plain.ply").read_bytes()
    comment = b"comment SplatRenderMode: mip\n"
    (tmp_path / "marked.ply").write_bytes(plain.replace(b"element vertex", comment + b"element vertex", 1))
    for name, expected in [("plain", False), ("marked", True)]:
        ours(tmp_path / f"{name}.ply", tmp_path / "a.spz")
        read_by("adobe", tmp_path / "a.spz", tmp_path)
        assert json.loads((tmp_path / "numbers.json").read_text())["antialiased"] == expected
        for version in "34":
            write_by("adobe", made(1), tmp_path / "b.spz", tmp_path, version, antialiased=expected)
            ours(tmp_path / "b.spz", tmp_path / "c.ply")
            assert (comment in (tmp_path / "c.ply").read_bytes()[:200]) == expected


# In compressed PLYs, spz-js mistakes coefficients of degree 1 and 2 for others, and reads their bytes as older viewers
# did.
@pytest.mark.parametrize("ending, degree", [*(("ply", degree) for degree in range(4)), ("compressed.ply", 0), ("compressed.ply", 3)])
def test_another_reader_of_plys_reads_and_writes_as_we_do(tmp_path, ending, degree):
    splat = made(degree)
    steps = STEPS[ending] if ending == "ply" else (*STEPS[ending][:5], 0.62 / 32)
    write_ply(tmp_path / "a.ply", splat)
    ours(tmp_path / "a.ply", tmp_path / f"b.{ending}")
    assert_same(splat, read_by("spz-js", tmp_path / f"b.{ending}", tmp_path), steps)
    write_by("spz-js", splat, tmp_path / f"c.{ending}", tmp_path)
    ours(tmp_path / f"c.{ending}", tmp_path / "d.ply")
    assert_same(splat, read_ply(tmp_path / "d.ply"), steps)
