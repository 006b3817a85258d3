"""Tests that third-party programs read the splats that our program writes, in every format, and vice versa.

Values must be equal up to each format's quantization. The programs are pinned in parity/npm, and installed by `npm ci`.
"""

import gzip
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
# Properties of a PLY.
POSITION, COLOR, SCALE = ["x", "y", "z"], ["f_dc_0", "f_dc_1", "f_dc_2"], ["scale_0", "scale_1", "scale_2"]
ROTATION = ["rot_0", "rot_1", "rot_2", "rot_3"]
# Half of each format's quantization step: positions, logarithms of scales, rotations, opacities, colors, coefficients.
STEPS = {
    "ply": (1e-6, 1e-5, 1e-5, 1e-5, 1e-6, 1e-6),
    "compressed.ply": (4.1 / 1023, 1.1 / 1023, 0.003, 0.51 / 255, 1 / 255, 0.51 / 32),
    "spz": (1e-6, 0.51 / 16, 0.003, 0.51 / 255, 0.51 / 255 / 0.15, 0.51 / 64),
    # Niantic's library uses 12 fractional bits for positions, and rounds coefficients to 8 bits, then to 5 and 4 of
    # them; version 2 has 8 bits per component of a rotation.
    "their spz": (0.51 / 4096, 0.51 / 16, 0.003, 0.51 / 255, 0.51 / 255 / 0.15, 8.51 / 128),
    "spz of version 2": (0.51 / 4096, 0.51 / 16, 0.12, 0.51 / 255, 0.51 / 255 / 0.15, 8.51 / 128),
    "splat": (1e-6, 1e-5, 0.02, 0.51 / 255, 0.51 / 255 / C0, 0),
    # Positions have 16 bits of ±ln(4.6), with steps in proportion to |x| + 1. Scales, colors and coefficients have 256
    # values at unequal steps: a whole one of equal steps. Rotations have 8 bits of ±1/√2 for three components, whose
    # errors add up in the fourth one.
    "sog": (1.02 / 65535 * 4.6 * np.log(4.6), 1.8 / 255, 3 * 0.51 * 2**0.5 / 255, 0.51 / 255, 1.8 / 255, 1.8 / 255),
    "glb": (1e-6, 1e-5, 1e-5, 1e-5, 1e-6, 1e-6),
    # Babylon.js keeps bytes of all but positions and scales.
    "glb in babylon": (1e-6, 1e-5, 1.02 / 127.5, 0.51 / 255, 0.51 / 255 / C0, 0.51 / 128),
    # Two programs read the same file.
    "same file": (1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6),
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
    rest = [f"f_rest_{k}" for k in range(3 * ((degree + 1) ** 2 - 1))]
    names = [*POSITION, *COLOR, *rest, "opacity", *SCALE, *ROTATION]
    splat = {name: random.uniform(-0.9, 0.9, COUNT) for name in names}
    for name in POSITION:
        splat[name] *= 4
    for name in SCALE:
        splat[name] -= 3
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


def columns(splat, names):
    """Returns the properties `names`, [N, names]."""
    return np.stack([splat[name].astype(np.float64) for name in names], 1) if names else np.zeros((len(splat["x"]), 0))


def rest(splat):
    count = sum(name.startswith("f_rest_") for name in splat)
    return columns(splat, [f"f_rest_{k}" for k in range(count)])


def unit_quaternions(splat):
    """Returns the rotations (w, x, y, z) with length 1."""
    rotations = columns(splat, ROTATION)
    return rotations / np.linalg.norm(rotations, axis=1, keepdims=True)


def assert_same(splat, other, steps):
    """Asserts that two splats are equal up to `steps`, in any order: each Gaussian is compared with the nearest one."""
    places, others = columns(splat, POSITION), columns(other, POSITION)
    nearest = ((places[:, None] - others) ** 2).sum(-1).argmin(1)
    assert len(others) == COUNT and len(set(nearest)) == COUNT
    other = {name: values[nearest] for name, values in other.items()}
    rotations = [unit_quaternions(one) for one in (splat, other)]
    rotations[1] *= np.sign((rotations[0] * rotations[1]).sum(1, keepdims=True))  # q and −q are the same rotation
    opacities = [1 / (1 + np.exp(-one["opacity"].astype(np.float64))) for one in (splat, other)]
    for what, a, b, step in [
        ("positions", places, others[nearest], steps[0]),
        ("scales", columns(splat, SCALE), columns(other, SCALE), steps[1]),
        ("rotations", *rotations, steps[2]),
        ("opacities", *opacities, steps[3]),
        ("colors", columns(splat, COLOR), columns(other, COLOR), steps[4]),
        ("coefficients", rest(splat), rest(other), steps[5]),
    ]:
        np.testing.assert_allclose(b, a, rtol=0, atol=step, err_msg=what)


def run(*command):
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def ours(source, target, *options):
    run(PROGRAM, "convert", source, target, *options)


def transformed(source, target, *options):
    """Converts a splat with PlayCanvas' splat-transform, which otherwise needs a GPU to write a SOG."""
    command = ["node", NPM / "node_modules/@playcanvas/splat-transform/bin/cli.mjs", "-q", "-w", "-g", "cpu"]
    run(*command, source, target, *options)


def cloud(splat):
    """Converts a splat to the layout of Niantic's library: basis-major coefficients, real part of a rotation last."""
    sh = rest(splat)
    lists = {
        "positions": columns(splat, POSITION),
        "scales": columns(splat, SCALE),
        "rotations": np.roll(unit_quaternions(splat), -1, axis=1),
        "alphas": columns(splat, ["opacity"]),
        "colors": columns(splat, COLOR),
        "sh": sh.reshape(COUNT, 3, -1).swapaxes(1, 2),
    }
    about = {"numPoints": COUNT, "shDegree": [0, 9, 24, 45].index(sh.shape[1]), "antialiased": False}
    return about | {name: values.ravel().tolist() for name, values in lists.items()}


def splat_of(cloud):
    """Converts a splat of that layout to a PLY's properties."""
    count = cloud["numPoints"]
    sh = np.array(cloud["sh"]).reshape(count, -1, 3).swapaxes(1, 2).reshape(count, -1)
    rotations = np.roll(np.reshape(cloud["rotations"], (count, 4)), 1, axis=1)
    splat = {f"f_rest_{k}": column for k, column in enumerate(sh.T)} | {"opacity": np.array(cloud["alphas"])}
    for names, list_of in [(POSITION, "positions"), (COLOR, "colors"), (SCALE, "scales")]:
        splat |= zip(names, np.reshape(cloud[list_of], (count, 3)).T, strict=True)
    return splat | dict(zip(ROTATION, rotations.T, strict=True))


def read_by(program, file, folder):
    run("node", NPM / "splats.mjs", "read", program, file, folder / "numbers.json")
    return splat_of(json.loads((folder / "numbers.json").read_text()))


def write_by_adobe(splat, file, folder, version, antialiased=False):
    (folder / "numbers.json").write_text(json.dumps(cloud(splat) | {"antialiased": antialiased}))
    run("node", NPM / "splats.mjs", "write", "adobe", folder / "numbers.json", file, version)


def named(folder, ending):
    """Returns the path of a file with this ending, or the file with this name in its own folder."""
    if not ending.endswith(".json"):
        return folder / f"b.{ending}"
    (folder / "b").mkdir()
    return folder / "b" / ending


def without_sh(splat):
    return {name: values for name, values in splat.items() if not name.startswith("f_rest_")}


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("ending", ["ply", "compressed.ply", "spz", "splat", "sog", "meta.json"])
def test_splat_transform_reads_ours(tmp_path, ending, degree):
    splat = made(degree)
    write_ply(tmp_path / "a.ply", splat)
    file = named(tmp_path, ending)
    ours(tmp_path / "a.ply", file)
    transformed(file, tmp_path / "c.ply")
    expected = without_sh(splat) if ending == "splat" else splat
    assert_same(expected, read_ply(tmp_path / "c.ply"), STEPS["sog" if ending == "meta.json" else ending])


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize(
    "ending, options",
    [("ply", []), ("compressed.ply", []), ("spz", ["--spz-version", 3]), ("spz", ["--spz-version", 4]), ("glb", [])],
)
def test_we_read_splat_transforms(tmp_path, ending, options, degree):
    splat = made(degree)
    write_ply(tmp_path / "a.ply", splat)
    transformed(tmp_path / "a.ply", tmp_path / f"b.{ending}", *options)
    ours(tmp_path / f"b.{ending}", tmp_path / "c.ply")
    assert_same(splat, read_ply(tmp_path / "c.ply"), STEPS["their spz" if ending == "spz" else ending])


# splat-transform's palette of coefficients is coarse for so few Gaussians, so both programs read its file.
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("ending", ["sog", "meta.json"])
def test_we_read_splat_transforms_sogs_as_it_does(tmp_path, ending, degree):
    splat = made(degree)
    write_ply(tmp_path / "a.ply", splat)
    file = named(tmp_path, ending)
    transformed(tmp_path / "a.ply", file)
    ours(file, tmp_path / "c.ply")
    transformed(file, tmp_path / "d.ply")
    read = read_ply(tmp_path / "c.ply")
    assert_same(read_ply(tmp_path / "d.ply"), read, STEPS["same file"])
    steps = [2 * step for step in STEPS["sog"]]  # splat-transform cuts numbers off instead of rounding them
    assert_same(without_sh(splat), without_sh(read), steps)


def spz_version(file):
    contents = file.read_bytes()
    header = contents if contents.startswith(b"NGSP") else gzip.decompress(contents)
    return int.from_bytes(header[4:8], "little")


@pytest.mark.parametrize("degree", range(4))
def test_niantics_library_reads_and_writes_as_we_do(tmp_path, degree):
    splat = made(degree)
    write_ply(tmp_path / "a.ply", splat)
    ours(tmp_path / "a.ply", tmp_path / "a.spz")
    assert spz_version(tmp_path / "a.spz") == 4
    for version in "234":
        of_two = STEPS["spz of version 2"]
        steps = (*STEPS["spz"][:2], of_two[2] if version == "2" else STEPS["spz"][2], *STEPS["spz"][3:])
        ours(tmp_path / "a.ply", tmp_path / "a.spz", "--spz-version", version)
        assert spz_version(tmp_path / "a.spz") == int(version)
        assert_same(splat, read_by("adobe", tmp_path / "a.spz", tmp_path), steps)
        write_by_adobe(splat, tmp_path / "b.spz", tmp_path, version)
        ours(tmp_path / "b.spz", tmp_path / "c.ply")
        assert_same(splat, read_ply(tmp_path / "c.ply"), of_two if version == "2" else STEPS["their spz"])


def test_niantics_library_and_we_read_the_same_axes(tmp_path):
    write_ply(tmp_path / "a.ply", made(3))
    ours(tmp_path / "a.ply", tmp_path / "a.spz")
    plain = (tmp_path / "a.spz").read_bytes()
    for code in range(1, 17):
        # The flags and the place of the table of contents in the header tell of the extension.
        extension = np.array([0xADBE0003, 4, code], "<u4").tobytes()
        header = plain[:14] + bytes([2, plain[15], 32 + len(extension)]) + plain[17:32]
        (tmp_path / "b.spz").write_bytes(header + extension + plain[32:])
        ours(tmp_path / "b.spz", tmp_path / "b.ply")
        expected = read_by("adobe", tmp_path / "b.spz", tmp_path)
        assert_same(expected, read_ply(tmp_path / "b.ply"), STEPS["same file"])


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
            write_by_adobe(made(1), tmp_path / "b.spz", tmp_path, version, antialiased=expected)
            ours(tmp_path / "b.spz", tmp_path / "c.ply")
            assert (comment in (tmp_path / "c.ply").read_bytes()[:200]) == expected


@pytest.mark.parametrize("degree", range(4))
def test_babylon_reads_our_gltf_as_it_reads_splat_transforms(tmp_path, degree):
    splat = made(degree)
    # splat-transform doesn't normalize rotations, of which Babylon.js keeps bytes.
    splat |= zip(ROTATION, unit_quaternions(splat).T.astype("<f4"), strict=True)
    write_ply(tmp_path / "a.ply", splat)
    for convert, name in [(transformed, "theirs.glb"), (ours, "ours.glb"), (ours, "ours.gltf")]:
        convert(tmp_path / "a.ply", tmp_path / name)
        assert_same(splat, read_by("babylon", tmp_path / name, tmp_path), STEPS["glb in babylon"])


# splat-transform turns a splat by 180° about z before it applies an edit, which reverses x and y.
@pytest.mark.parametrize(
    "edit, their_edit",
    [
        (["--rotate", "-10,-20,-35"], ["-r", "10,20,-35"]),
        (["--translate", "-1,-2,3", "--scale", "2.5"], ["-t", "1,2,3", "-s", "2.5"]),
        (["--crop-box", "-2,-1,-3,1,3,2.5"], ["-B", "-1,-3,-3,2,1,2.5"]),
        (["--crop-sphere", "1,-1,0.5,3"], ["-S", "-1,1,0.5,3"]),
        (["--min-opacity", "0.5"], ["-V", "opacity,gte,0.5"]),
        (["--sh-degree", "1"], ["-H", "1"]),
    ],
)
def test_edits_are_those_of_splat_transform(tmp_path, edit, their_edit):
    splat = made(3)
    write_ply(tmp_path / "a.ply", splat)
    ours(tmp_path / "a.ply", tmp_path / "b.ply", *edit)
    transformed(tmp_path / "a.ply", tmp_path / "c.ply", *their_edit)
    found, expected = read_ply(tmp_path / "b.ply"), read_ply(tmp_path / "c.ply")
    assert len(found["x"]) == len(expected["x"]) > 0
    assert "crop" not in edit[0] or len(found["x"]) < COUNT
    np.testing.assert_allclose(np.abs((unit_quaternions(found) * unit_quaternions(expected)).sum(1)), 1, atol=1e-6)
    for name in set(expected) - {*ROTATION, "nx", "ny", "nz"}:
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-5, err_msg=name)
