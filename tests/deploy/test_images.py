"""Images, intrinsics and poses as they are given: their geometry, and what is refused."""

import os
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csac_jax.deploy import image_files as files, images
from csac_jax.deploy.images import Intrinsics
from csac_jax.errors import SettingsError
from tests.deploy import image_files, scenes

IDEAL = {"width": 64, "height": 48, "fx": 60.0, "fy": 62.0, "cx": 31.0, "cy": 24.5}
LENS = (0.12, -0.25, 0.001, -0.002, 0.09)  # k1 k2 p1 p2 k3, as strong as a colour camera's
POSE = scenes.pose_of()
RGB, DEPTH = np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32)


@pytest.mark.parametrize(
    ("lens", "wanted"),
    [
        ((0.1, 0.0, 0.0, 0.0), (0.5 * 1.029, 0.2 * 1.029)),  # r^2 = 0.29
        ((0.0, 0.1, 0.0, 0.0), (0.5 * 1.00841, 0.2 * 1.00841)),
        ((0.0, 0.0, 0.1, 0.0), (0.5 + 0.02, 0.2 + 0.1 * (0.29 + 0.08))),
        ((0.0, 0.0, 0.0, 0.1), (0.5 + 0.1 * (0.29 + 0.5), 0.2 + 0.02)),
        ((0.0, 0.0, 0.0, 0.0, 1.0), (0.5 * 1.024389, 0.2 * 1.024389)),
    ],
)
def test_distortion_is_opencv_s(lens: tuple[float, ...], wanted: tuple[float, float]):
    """Claim: each coefficient moves (0.5, 0.2) as OpenCV's formula does, worked out by hand."""
    camera = Intrinsics(**IDEAL, distortion=lens)
    np.testing.assert_allclose(images.distort(camera, np.array([0.5, 0.2])), wanted, atol=1e-9)


def test_points_are_the_scene_s():
    """Claim: the points of a rendered cube lie on its five visible planes, to 0.1 mm."""
    image = scenes.take(scenes.blocks_at([[0.0, 0.0, 0.0]], 0.025))
    view = images.make(*image)
    x, y, z = view.points[view.valid].T
    near = (np.abs(x) < 0.1) & (np.abs(y) < 0.1)
    faces = (z, z - 0.05, x - 0.025, x + 0.025, y - 0.025, y + 0.025)
    assert np.min(np.abs(faces), axis=0)[near].max() < 1e-4
    assert (z[near] > 0.049).sum() > 500


def test_missing_depth_is_missing():
    """Claim: zero, NaN, infinite and negative depths are pixels without one."""
    depth = DEPTH.copy()
    depth[0, :5] = 0.0, np.nan, np.inf, -np.inf, -0.5
    view = images.make(RGB, depth, IDEAL, POSE)
    assert not view.valid[0, :5].any()
    assert view.valid.sum() == view.valid.size - 5
    assert np.isfinite(view.points).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rgb": RGB / 255.0}, "rgb: is float64; give 0 to 255 as uint8"),
        ({"rgb": np.zeros((48, 64, 4), np.uint8)}, "leave out its alpha: rgb[..., :3]"),
        ({"depth": (1000 * DEPTH).astype(np.uint16)}, "depth * 0.001 for millimetres"),
        ({"depth": DEPTH[::2]}, "rgb 64 x 48, depth 64 x 24, intrinsics 64 x 48: align them"),
        ({"target_mask": RGB[:, :, 0]}, "target_mask: marks no pixel"),
        ({"intrinsics": {"fx": 600.0}}, "intrinsics: 'width' is missing"),
        ({"intrinsics": {**IDEAL, "fx": 0.0}}, "'fx' should be greater than 0"),
        ({"intrinsics": {**IDEAL, "fy": np.nan}}, "'fy' should be a finite number"),
        ({"intrinsics": {**IDEAL, "distortion": [0.1, 0.2]}}, "4 or 5 numbers, k1 k2 p1 p2 k3"),
        ({"intrinsics": {**IDEAL, "distortion": [-4.0, 0, 0, 0]}}, "has no inverse over the image"),
        ({"camera_pose": "pose"}, "camera_pose: must be a 4 x 4 matrix of finite numbers"),
        ({"camera_pose": POSE.T}, "it may be transposed, scaled or mirrored"),
        ({"camera_pose": POSE * np.nan}, "must be a 4 x 4 matrix of finite numbers"),
    ],
)
def test_wrong_form_is_refused(changes: dict[str, Any], message: str):
    """Claim: arrays of a wrong form give one line that says what to change."""
    sound = {"rgb": RGB, "depth": DEPTH, "intrinsics": IDEAL, "camera_pose": POSE}
    with pytest.raises(SettingsError, match=re.escape(message)) as caught:
        images.make(**(sound | changes)).points  # noqa: B018, the rays are made here
    assert "\n" not in str(caught.value)


READERS = {
    "rgb.png": files.read_rgb,
    "depth.png": files.read_depth,
    "depth.npy": files.read_depth,
    "mask.png": files.read_mask,
    "mask.npy": files.read_mask,
    "intrinsics.json": files.read_intrinsics,
    "pose.json": files.read_pose,
}


@pytest.mark.parametrize(("name", "read"), READERS.items(), ids=READERS)
def test_pipes_are_refused(tmp_path: Path, name: str, read: Callable[[Path], Any]):
    """Claim: a pipe, which may never end, is no file of an image. It is refused at once."""
    os.mkfifo(tmp_path / name)
    errors: list[Exception] = []

    def attempt() -> None:
        try:
            read(tmp_path / name)
        except SettingsError as error:
            errors.append(error)

    thread = threading.Thread(target=attempt, daemon=True)
    thread.start()
    thread.join(5.0)
    assert len(errors) == 1, "it waits"
    assert f"{name}: is a folder, a pipe or a device" in str(errors[0])


def test_size_is_that_of_the_pixels():
    """Claim: an image's size is checked as it is decoded: of two headers the second counts, and an
    image of more than 4,096 px a side is refused before it is decoded."""
    assert files.size(image_files.png_start((64, 48))) == (64, 48)
    assert files.size(image_files.png_start((64, 48), (5000, 50))) == (5000, 50)
    with pytest.raises(SettingsError, match="has 5000 x 50 px; at most 4096 a side"):
        files.decode(image_files.png_start((64, 48), (5000, 50)))
    with pytest.raises(SettingsError, match="the image is damaged"):
        files.decode(image_files.png_start((64, 48)))
