"""Tests of the image metrics of `globalsplat eval` against scikit-image."""

import json
import os

import numpy as np
import pytest
from command_line import succeed
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

SIZES = [(11, 11), (48, 37), (64, 96)]


def waves(rng, height, width):
    """Returns an 8-bit image with structure at all scales."""
    y, x = np.mgrid[0:height, 0:width]
    picture = np.zeros((height, width, 3))
    for k in range(1, 7):
        phase, angle = rng.uniform(0, 2 * np.pi, (2, 3))
        picture += np.sin(k * 0.3 * (x[..., None] * np.cos(angle) + y[..., None] * np.sin(angle)) + phase) / k
    picture = (picture - picture.min()) / np.ptp(picture)
    return (255 * picture).astype(np.uint8)


def write_capture(folder, photos):
    (folder / "images").mkdir(parents=True)
    height, width = photos[0].shape[:2]
    views = []
    for i, photo in enumerate(photos):
        Image.fromarray(photo).save(folder / f"images/{i}.png")
        pose = np.eye(4)
        pose[0, 3] = i
        k = [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]
        views.append({"image": f"images/{i}.png", "intrinsic": k, "c2w": pose.tolist()})
    (folder / "cameras.json").write_text(json.dumps({"image_shape": [height, width], "views": views}))


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_psnr_and_ssim_are_scikit_images(tmp_path, height, width):
    rng = np.random.default_rng(height)
    photos = [waves(rng, height, width) for _ in range(4)]
    noisy = photos[0] + rng.normal(0, 20, photos[0].shape)
    pictures = [
        np.clip(noisy, 0, 255).astype(np.uint8),
        np.roll(photos[1], 2, axis=1),
        (photos[2] * 0.6).astype(np.uint8),
        rng.integers(0, 256, photos[3].shape, dtype=np.uint8),
    ]
    write_capture(tmp_path / "capture", photos)
    (tmp_path / "renders").mkdir()
    for i, picture in enumerate(pictures):
        Image.fromarray(picture).save(tmp_path / f"renders/{i}.png")
    # Without the weights of LPIPS, which takes longer than all the rest.
    environment = os.environ | {"GLOBALSPLAT_WEIGHTS": str(tmp_path)}
    scores = succeed("eval", "--renders", tmp_path / "renders", "--scene", tmp_path / "capture", env=environment)
    for view, photo, picture in zip(scores["views"], photos, pictures, strict=True):
        a, b = photo / 255.0, picture / 255.0
        assert view["psnr"] == pytest.approx(peak_signal_noise_ratio(a, b, data_range=1.0), abs=1e-5)
        theirs = structural_similarity(
            a, b, gaussian_weights=True, sigma=1.5, win_size=11, data_range=1.0, channel_axis=-1
        )
        assert view["ssim"] == pytest.approx(theirs, abs=1e-5)
