"""Counts the verdicts of `globalsplat capture` on captures, and on what goes wrong with them: half of the photos, blurred photos, photos
exchanged among the poses, and half of the poses turned by 5, 10 and 20 degrees, in place or about their center.

    python scripts/verdicts.py CAPTURE... (each with a transforms.json, a transforms_train.json or a cameras.json)
"""

import json
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageFilter

PROGRAM = Path(__file__).parents[1] / "target/release/globalsplat"
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
Photo = tuple[Path, np.ndarray, dict[str, float | str]]


def read(folder: Path) -> list[Photo]:
    """Returns the photos of a capture: file, pose with OpenGL's axes, and the other keys of a frame of transforms.json."""
    cameras = folder / "cameras.json"
    if cameras.is_file():
        contents = json.loads(cameras.read_text())
        height, width = contents["image_shape"]
        photos = []
        for view in contents["views"]:
            (fx, _, cx), (_, fy, cy), _ = view["intrinsic"]
            lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height}
            photos.append((folder / view["image"], np.array(view["c2w"]) @ FLIP, lens))
        return photos
    file = next(file for name in ("", "_train") if (file := folder / f"transforms{name}.json").is_file())
    contents = json.loads(file.read_text())
    frames = sorted(contents.pop("frames"), key=lambda frame: (len(frame["file_path"]), frame["file_path"]))
    lens = {key: value for key, value in contents.items() if key == "camera_model" or isinstance(value, int | float)}
    paths = [(folder / frame["file_path"], frame) for frame in frames]
    return [
        (
            path,
            np.array(frame["transform_matrix"]),
            lens | {k: v for k, v in frame.items() if k == "camera_model" or isinstance(v, int | float)},
        )
        for path, frame in paths
        if path.is_file()
    ]


def verdict(photos: list[Photo], edit: Callable[[Image.Image], Image.Image] | None = None) -> str:
    """Returns the verdict on a capture of these photos, each of which `edit` changes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames = []
        for index, (path, pose, lens) in enumerate(photos):
            copy = folder / f"{index:04}{'.png' if edit else path.suffix}"
            if edit:
                edit(Image.open(path).convert("RGB")).save(copy)
            else:
                shutil.copy(path, copy)
            frames.append({"file_path": copy.name, "transform_matrix": pose.tolist(), **lens})
        (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
        command = [str(PROGRAM), "capture", str(folder), "--json"]
        result = subprocess.run(command, check=True, capture_output=True, text=True)
        return str(json.loads(result.stdout)["verdict"])


def turned(photos: list[Photo], degrees: float, *, in_place: bool) -> list[Photo]:
    """Turns the poses of the second half of the photos, each about itself or all about the center of all cameras."""
    axis = np.array([0.3, 1.0, 0.2]) / np.linalg.norm([0.3, 1.0, 0.2])
    cross = np.cross(np.eye(3), -axis)
    angle = np.radians(degrees)
    # Rodrigues' formula.
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    center = np.mean([pose[:3, 3] for _, pose, _ in photos], axis=0)
    result = []
    for index, (path, pose, lens) in enumerate(photos):
        new = pose.copy()
        if index >= len(photos) // 2:
            new[:3, :3] = rotation @ pose[:3, :3]
            if not in_place:
                new[:3, 3] = rotation @ (pose[:3, 3] - center) + center
        result.append((path, new, lens))
    return result


def blurred(image: Image.Image) -> Image.Image:
    """Blurs an image by a 200th of its longer side."""
    return image.filter(ImageFilter.GaussianBlur(max(image.size) / 200))


def exchanged(photos: list[Photo]) -> list[Photo]:
    """Exchanges the photos among the poses."""
    files = [path for path, *_ in photos]
    random.Random(0).shuffle(files)
    return [(file, pose, lens) for file, (_, pose, lens) in zip(files, photos, strict=True)]


def main() -> None:
    """Prints a line per capture, a verdict per change."""
    for folder in map(Path, sys.argv[1:]):
        photos = read(folder)
        verdicts = {"as it is": verdict(photos), "half": verdict(photos[::2]), "blurred": verdict(photos, blurred)}
        verdicts["exchanged"] = verdict(exchanged(photos))
        for degrees in (5, 10, 20):
            verdicts[f"{degrees}°"] = verdict(turned(photos, degrees, in_place=False))
            verdicts[f"{degrees}° in place"] = verdict(turned(photos, degrees, in_place=True))
        print(folder.name, *(f"{change}: {found}" for change, found in verdicts.items()), sep="; ", flush=True)


if __name__ == "__main__":
    main()
