"""Images that do not fit the camera's pose, the table or the workspace."""

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from csac_jax.config import CameraConfig, HeightmapConfig
from csac_jax.deploy import checks, images
from csac_jax.deploy.images import CameraView
from csac_jax.errors import ViewError
from tests.deploy import scenes
from tests.deploy.scenes import Image

MAP = HeightmapConfig(64)
IMAGE = scenes.take(scenes.blocks_at([[0.1, 0.1, 0.4], [-0.1, 0.0, 1.0], [0.05, -0.1, 2.0]]))
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def _view(image: Image = IMAGE, **changes: Any) -> CameraView:
    return images.make(*image._replace(**changes))


def _check(**changes: Any) -> None:
    checks.fits(_view(**changes), MAP)


def _moved(shift: Any = (0, 0, 0), turn_deg: Any = (0, 0, 0)) -> np.ndarray:
    """Returns the camera's pose for a table that is shifted, m, and turned."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    motion[:3, 3] = shift
    return motion @ IMAGE.pose


def test_sound_image_passes():
    """Claim: an image with objects and a fifth of its depth missing is accepted, also where the
    table is 2 mm off and tilted by 0.5 degrees."""
    depth = IMAGE.depth.copy()
    depth[np.random.default_rng(0).uniform(size=depth.shape) < 0.2] = 0.0
    _check(depth=depth, pose=_moved((0, 0, 0.002), (0.5, 0, 0)))


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1000.0, "millimetres"), (100.0, "centimetres"), (10.0, ""), (0.1, ""), (0.001, "")],
)
def test_unit_of_depth_is_named(factor: float, unit: str):
    """Claim: depth in another unit is refused with the factor that mends it, which does."""
    wrong = IMAGE.depth * np.float32(factor)
    with pytest.raises(ViewError, match=f"seems to be {unit}.*; multiply it by ") as caught:
        _check(depth=wrong)
    mend = float(str(caught.value).split()[-1])
    _check(depth=(wrong * mend).astype(np.float32))


def test_depth_beyond_floats_is_refused():
    """Claim: depth that is infinite in float32 is refused in one line."""
    with pytest.raises(ViewError, match="depth there is inf times") as caught:
        _check(depth=np.full(IMAGE.depth.shape, 1e308))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("pose", "hint"),
    [
        (np.linalg.inv(IMAGE.pose), "give its inverse"),
        (IMAGE.pose @ FLIP, "its axes seem to be OpenGL's; turn y and z round"),
        (_moved(shift=(1.5, 0, 0)), "check it, x right, y down, z forward"),
        (_moved(shift=(700, 0, 0)), "the camera is 700 m away; its unit is m"),
    ],
)
def test_pose_that_sees_no_workspace(pose: np.ndarray, hint: str):
    """Claim: a pose that looks elsewhere is refused, with what would mend it where that is seen."""
    with pytest.raises(ViewError, match=re.escape(hint)):
        _check(pose=pose)


@pytest.mark.parametrize(("shift_mm", "turn_deg"), [(20.0, 0.0), (0.0, 3.0), (10.0, -2.0)])
def test_table_is_measured(shift_mm: float, turn_deg: float):
    """Claim: height and tilt of a table that is not at z = 0 are told, to 0.5 mm and 0.1 degrees,
    objects and depth noise notwithstanding."""
    noise = np.random.default_rng(0).normal(0.0, 0.001, IMAGE.depth.shape).astype(np.float32)
    changes = {"pose": _moved((0, 0, 1e-3 * shift_mm), (turn_deg, 0, 0))}
    changes["depth"] = IMAGE.depth + noise
    found = checks.table(_view(**changes), MAP.extent)
    assert found.height_mm == pytest.approx(shift_mm, abs=0.5)
    assert found.tilt_deg == pytest.approx(abs(turn_deg), abs=0.1)
    worst = abs(shift_mm) + 1e3 * 0.5 * MAP.extent * np.tan(np.radians(abs(turn_deg)))
    assert found.worst_mm == pytest.approx(worst, abs=1.0)
    assert found.noise_mm == pytest.approx(np.cos(np.pi / 4), rel=0.2)
    line = f"the table lies {shift_mm:+.0f} mm from z = 0, tilted by"
    with pytest.raises(ViewError, match=re.escape(line)):
        _check(**changes)


def test_no_table():
    """Claim: where points of the workspace form no plane, no table is found, and it is said how
    far the depth is from a table's; an image without any depth is refused."""
    rng = np.random.default_rng(0)
    rough = (IMAGE.depth * rng.uniform(0.7, 1.0, IMAGE.depth.shape)).astype(np.float32)
    with pytest.raises(ViewError, match=r"no table found .* is 0\.8\d times that of a table"):
        _check(depth=rough)
    with pytest.raises(ViewError, match="all of the workspace is 0 or NaN"):
        _check(depth=np.zeros_like(IMAGE.depth))


def test_missing_part_is_named():
    """Claim: less than four fifths of the workspace is refused, with the part and the cause: no
    depth, or a camera that looks elsewhere. What objects hide does not count as unseen."""
    view = _view()
    y = np.where(view.valid, view.points[..., 1], 0.0)
    depth = np.where(y > 0.08, np.nan, IMAGE.depth)
    with pytest.raises(ViewError) as caught:
        _check(depth=depth)
    share, x0, x1, y0, y1 = map(
        float, re.findall(r"[-+]?\d+(?:\.\d+)?(?=% of| to | m[ ,])", str(caught.value))
    )
    assert share == pytest.approx(100 * (0.08 + 0.224) / 0.448, abs=4)
    np.testing.assert_allclose([x0, x1, y0, y1], [-0.22, 0.22, 0.08, 0.22], atol=0.02)
    assert "has no depth" in str(caught.value)
    narrow = dataclasses.replace(CameraConfig(), focal=(900.0, 900.0), look_at=(0.0, 0.15, 0.0))
    with pytest.raises(ViewError, match=r"of the workspace is seen.* is outside of the image"):
        _check(image=scenes.take(scenes.blocks_at([[0.1, 0.1, 0.0]]), narrow))
    wall = scenes.blocks_at([[-0.1, 0.0, 0.0]], [0.01, 0.2, 0.06])
    assert checks.seen(_view(scenes.take(wall)), MAP)[1].all()


@pytest.mark.slow
def test_swapped_colours_are_noticed():
    """Claim: of ten images with red and blue swapped all are noticed, and none as they are."""
    rng = np.random.default_rng(1)
    for _ in range(10):
        num = int(rng.integers(1, 5))
        shapes = scenes.blocks_at(scenes.random_poses(rng, num), colours=rng.integers(10, size=num))
        image = scenes.take(shapes)
        assert not checks.colours_swapped(_view(image), MAP.extent)
        assert checks.colours_swapped(_view(image, rgb=image.rgb[..., ::-1]), MAP.extent)
