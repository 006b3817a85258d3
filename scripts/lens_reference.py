#!/usr/bin/env python3
"""Writes what tests of crates/capture compare with pycolmap, into its tests/data: `lens_models.json`, rays and pixels of every COLMAP
camera model, and `rig`, a model of two cameras on a rig, as COLMAP has written it since 3.12.

    python -m venv VENV && VENV/bin/pip install pycolmap==4.2.1
    VENV/bin/python scripts/lens_reference.py

The parameters are random, of several cameras per model. `cargo test -p globalsplat-capture --test lenses` compares the file.
"""

import json
import pathlib

import numpy as np
import pycolmap

FOLDER = pathlib.Path(__file__).parent.parent / "crates/capture/tests/data"
CAMERAS = 3  # per model
POINTS = 8  # per camera
# Largest error in pixels of pycolmap's own way back and forth: its iterations end early in some corners.
EXACT = 1e-8

# Ranges of the parameters after the focal lengths and the principal point, in COLMAP's order.
K1, K2, K3, P, S = (-0.12, 0.12), (-0.03, 0.03), (-0.005, 0.005), (-0.01, 0.01), (-0.01, 0.01)
RANGES = {
    "SIMPLE_PINHOLE": [],
    "PINHOLE": [],
    "SIMPLE_RADIAL": [K1],
    "RADIAL": [K1, K2],
    "OPENCV": [K1, K2, P, P],
    "FULL_OPENCV": [K1, K2, P, P, K3, K1, K2, K3],
    "OPENCV_FISHEYE": [K1, K2, K3, K3],
    "SIMPLE_RADIAL_FISHEYE": [K1],
    "RADIAL_FISHEYE": [K1, K2],
    "THIN_PRISM_FISHEYE": [K1, K2, P, P, K3, K3, S, S],
    "RAD_TAN_THIN_PRISM_FISHEYE": [K1, K2, K3, K3, (-1e-3, 1e-3), (-1e-4, 1e-4), P, P, S, S, S, S],
    "FOV": [(0.3, 1.4)],
    "SIMPLE_DIVISION": [(-0.4, 0.1)],
    "DIVISION": [(-0.4, 0.1)],
    "SIMPLE_FISHEYE": [],
    "FISHEYE": [],
    "EUCM": [(0.2, 0.8), (0.7, 1.4)],
    "EQUIRECTANGULAR": [],
}
# Models with one focal length.
SIMPLE = {"SIMPLE_RADIAL", "RADIAL", "RADIAL_FISHEYE"} | {name for name in RANGES if name.startswith("SIMPLE_")}


def main():
    random = np.random.default_rng(7)
    cameras = []
    for model, ranges in RANGES.items():
        count = 0
        while count < CAMERAS:
            camera = draw_camera(random, model, ranges)
            points = draw_points(random, camera)
            if points is not None:
                count += 1
                params = [float(value) for value in camera.params]
                cameras.append(
                    {"model": model, "size": [camera.height, camera.width], "params": params, "points": points}
                )
    lines = ",\n".join(json.dumps(camera) for camera in cameras)
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / "lens_models.json").write_text(f'{{"pycolmap": "{pycolmap.__version__}", "cameras": [\n{lines}\n]}}\n')
    write_rig(FOLDER / "rig")


def draw_camera(random, model, ranges):
    height = int(random.integers(300, 900))
    if model == "EQUIRECTANGULAR":
        return pycolmap.Camera(model=model, width=2 * height, height=height, params=[2 * height, height])
    width = int(height * random.uniform(0.7, 1.8))
    # A fisheye shows about 60 degrees at the longer side.
    focal = max(width, height) * random.uniform(0.5, 0.8) * random.uniform(0.97, 1.03, 1 if model in SIMPLE else 2)
    center = np.array([width, height]) * random.uniform(0.45, 0.55, 2)
    others = [random.uniform(*bounds) for bounds in ranges]
    params = np.concatenate([focal, center, others]).round(6)
    return pycolmap.Camera(model=model, width=width, height=height, params=params)


def draw_points(random, camera):
    """Returns [u, v, x, y, z] of random pixels and their rays, or None if the camera folds its image."""
    pixels = random.uniform(0, [camera.width, camera.height], (POINTS, 2)).round(3)
    rays = camera.cam_ray_from_img(pixels)
    back = [camera.img_from_cam(ray) for ray in rays]
    if any(pixel is None for pixel in back) or not np.all(np.linalg.norm(back - pixels, axis=1) < EXACT):
        return None
    return np.concatenate([pixels, rays.round(12)], axis=1).tolist()


def write_rig(folder):
    """Writes a model of three frames of a rig, in both forms. Its photos are 24 × 16 pixels."""
    model = pycolmap.Reconstruction()
    for camera, focal in enumerate((21.5, 23), 1):
        params = [focal, 20.25, 11.75, 8.5]
        model.add_camera(pycolmap.Camera(camera_id=camera, model="PINHOLE", width=24, height=16, params=params))
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera) for camera in (1, 2)]
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], pose([0.1, 0.2, -0.3, 0.9], [0.3, -0.1, 0.2]))
    model.add_rig(rig)
    for number in range(3):
        frame = pycolmap.Frame(frame_id=number + 1, rig_id=1)
        frame.rig_from_world = pose([0.3 * number, -0.2, 0.1 * number, 0.8], [number, 0.5 * number, 1 - number])
        images = [2 * number + 1, 2 * number + 2]
        for sensor, image in zip(sensors, images, strict=True):
            frame.add_data_id(pycolmap.data_t(sensor, image))
        model.add_frame(frame)
        for camera, image in enumerate(images, 1):
            name = f"{['left', 'right'][camera - 1]}/{number}.png"
            model.add_image(pycolmap.Image(image_id=image, name=name, camera_id=camera, frame_id=frame.frame_id))
        model.register_frame(frame.frame_id)
    folder.mkdir(exist_ok=True)
    model.write_binary(folder)
    model.write_text(folder)
    for form in ("bin", "txt"):
        (folder / f"points3D.{form}").unlink()


def pose(quaternion, translation):
    quaternion = np.array(quaternion)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion)), np.array(translation, float))


if __name__ == "__main__":
    main()
