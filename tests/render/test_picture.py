"""Pictures and videos, read back by ffmpeg; both ways of drawing, beside one another."""

import json
import os
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import jax
import mujoco
import numpy as np
import pytest

from csac_jax.render import gl, picture
from csac_jax.render.picture import View

BALL = """
<mujoco>
  <worldbody>
    <light pos="0 0 2" dir="0 0 -1"/>
    <geom type="plane" size="3 3 0.1" rgba="0.2 0.2 0.2 1"/>
    <geom type="box" size="0.1 0.1 0.1" pos="0.1 -0.25 0.1" rgba="0.9 0.1 0.1 1"/>
    <geom type="box" size="0.05 0.05 0.2" pos="0.1 0.25 0.2" rgba="0.1 0.9 0.1 1"/>
  </worldbody>
</mujoco>
"""
VIEW = View(position=(-1.0, 0.0, 0.8), look_at=(0.0, 0.0, 0.1), size=(96, 64))
_BOTH = f"""
import csac_jax, json, sys
from csac_jax.show import gl
backend = gl.choose()
if backend is None:
    sys.exit(3)
import mujoco, numpy as np
from csac_jax.show import picture
model = mujoco.MjModel.from_xml_string('''{BALL}''')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
view = picture.View({VIEW.position}, {VIEW.look_at}, {VIEW.size})
pictures = [draw(model, view)(data) for draw in (picture._by_mujoco, picture._by_rays)]
print(json.dumps([image.tolist() for image in pictures]))
"""


def _read(path: Path) -> np.ndarray:
    """A PNG as ffmpeg reads it, [H, W, 3]."""
    frames = imageio_ffmpeg.read_frames(str(path))
    width, height = next(frames)["size"]
    return np.frombuffer(next(frames), np.uint8).reshape(height, width, 3)


def test_png_is_what_was_drawn(tmp_path: Path):
    """Claim: a picture is written without loss, of any size, into folders that need not exist."""
    drawn = np.random.default_rng(0).integers(0, 256, (30, 46, 3), np.uint8)
    picture.write_png(tmp_path / "new" / "a.png", drawn)
    np.testing.assert_array_equal(_read(tmp_path / "new" / "a.png"), drawn)


def test_video_has_every_picture(tmp_path: Path):
    """Claim: a video has as many pictures as were given, 25 a second, of their size and about their
    colour."""
    shades = [np.full((48, 34, 3), shade, np.uint8) for shade in range(40, 240, 8)]
    assert picture.write_video(tmp_path / "a.mp4", iter(shades)) == len(shades) == 25
    assert imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4")) == (
        25,
        pytest.approx(1.0, abs=0.01),
    )
    frames = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    assert next(frames)["size"] == (34, 48)
    for shade, frame in zip(shades, frames, strict=True):
        assert np.abs(np.frombuffer(frame, np.uint8).astype(int) - shade[0, 0, 0]).mean() < 6


def test_rays_show_what_stands_where():
    """Claim: with no OpenGL, what is left of the view's middle is drawn left, what is farther up
    higher."""
    model = mujoco.MjModel.from_xml_string(BALL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    drawn = picture.artist(model, VIEW, None)(data)
    assert (drawn.shape, drawn.dtype) == ((64, 96, 3), np.uint8)
    red, green = (_where(drawn, channel) for channel in (0, 1))
    assert green[1] < 48 < red[1]  # y > 0 is left for who looks along x
    assert green[0] < red[0]  # the taller one


def _where(drawn: np.ndarray, channel: int) -> np.ndarray:
    """Mean row and column of the pixels of one colour."""
    pixels = drawn.astype(int)
    seen = pixels[..., channel] > 60 + np.delete(pixels, channel, axis=2).max(axis=2)
    assert seen.sum() > 20
    return np.argwhere(seen).mean(axis=0)


def test_both_ways_of_drawing_agree():
    """Claim: MuJoCo's renderer and our rays show the same things in the same places, to the
    pixel."""
    done = subprocess.run(
        [sys.executable, "-c", _BOTH], capture_output=True, text=True, timeout=300
    )
    if done.returncode == 3:
        pytest.skip("no OpenGL here")
    assert done.returncode == 0, done.stderr
    by_mujoco, by_rays = (np.array(image, np.uint8) for image in json.loads(done.stdout))
    for channel in (0, 1):
        np.testing.assert_allclose(_where(by_mujoco, channel), _where(by_rays, channel), atol=1.0)


def test_broken_opengl_gives_way_to_rays(monkeypatch: pytest.MonkeyPatch):
    """Claim: where the OpenGL that was found does not draw, the rays do."""

    def broken(*_):
        raise RuntimeError("no context")

    monkeypatch.setattr(picture, "_by_mujoco", broken)
    model = mujoco.MjModel.from_xml_string(BALL)
    assert picture.artist(model, VIEW, "egl")(mujoco.MjData(model)).shape == (64, 96, 3)


@pytest.mark.parametrize(
    ("given", "working", "chosen"),
    [
        (None, ("egl", "osmesa"), "egl"),
        (None, ("osmesa",), "osmesa"),
        (None, (), None),
        ("glfw", ("egl",), "glfw"),
        ("off", ("egl",), None),
    ],
)
def test_choice_of_opengl(
    monkeypatch: pytest.MonkeyPatch, given: str | None, working: tuple, chosen: str | None
):
    """Claim: EGL is tried first, then OSMesa; what the user has set stands."""
    monkeypatch.delenv(gl.VARIABLE, raising=False)
    if given is not None:
        monkeypatch.setenv(gl.VARIABLE, given)
    monkeypatch.setattr(gl, "_draws", working.__contains__)
    assert gl.choose() == chosen
    assert os.environ.get(gl.VARIABLE) == (given or chosen)


def test_probe_fails_on_a_backend_that_is_none():
    """Claim: the probe tells a backend that does not draw."""
    assert not gl._draws("nonsense")


def test_no_image_is_kept_on_the_device():
    """Claim: pictures are NumPy arrays."""
    model = mujoco.MjModel.from_xml_string(BALL)
    assert not isinstance(picture.artist(model, VIEW, None)(mujoco.MjData(model)), jax.Array)
