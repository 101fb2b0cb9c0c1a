"""Both ways of drawing a model, against each other, and the choice between them."""

import json
import os
import subprocess
import sys

import jax
import mujoco
import numpy as np
import pytest

from csac_jax.config import SceneConfig, SimConfig
from csac_jax.render import gl, picture
from csac_jax.render.picture import Viewpoint
from csac_jax.world import model as world_model, scene_state

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
VIEW = Viewpoint(position=(-1.0, 0.0, 0.8), look_at=(0.0, 0.0, 0.1), size=(96, 64))
_BOTH = f"""
import json, sys
from csac_jax.render import gl
if gl.choose() is None:
    sys.exit(3)
import mujoco
from csac_jax.render import picture
from csac_jax.render.picture import Viewpoint
def pictures(xml):
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ways = (picture._opengl_renderer, picture._ray_renderer)
    return [draw(model, {VIEW})(data) for draw in ways]
skies = pictures("<mujoco><worldbody><geom size='0.1'/></worldbody></mujoco>")
shown = pictures('''{BALL}''')
print(json.dumps([[image.tolist() for image in shown], [image[0, 0].tolist() for image in skies]]))
"""


def test_rays_show_what_stands_where():
    """Claim: without OpenGL, left is drawn left, and farther up higher."""
    model = mujoco.MjModel.from_xml_string(BALL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    drawn = picture.renderer(model, VIEW, None)(data)
    assert (type(drawn), drawn.shape, drawn.dtype) == (np.ndarray, (64, 96, 3), np.uint8)
    assert drawn[-1].min() > 80  # the floor, whatever its colour in the model
    red, green = (_where(drawn, channel) for channel in (0, 1))
    assert green[1] < 48 < red[1]  # y > 0 is left for who looks along x
    assert green[0] < red[0]  # the taller one


def test_rays_shade_by_the_normal():
    """Claim: a pixel is its geom's colour times a brightness by the normal, or white; a box has a
    brightness for each side that is seen, a round geom many."""
    sizes = {"box": "0.1 0.1 0.1", "sphere": "0.1", "ellipsoid": "0.1 0.2 0.05"}
    sizes |= dict.fromkeys(("cylinder", "capsule"), "0.1 0.2")
    geoms = "".join(
        f'<geom type="{kind}" size="{size}" pos="0 {0.5 * i - 1} 0" rgba=".2 .4 {0.4 + i / 10} 1"/>'
        for i, (kind, size) in enumerate(sizes.items())
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    far = Viewpoint(position=(-2.0, 0.0, 1.6), look_at=(0.0, 0.0, 0.0), size=(192, 64))
    drawn = picture.renderer(model, far, None)(data).reshape(-1, 3)
    seen = drawn[drawn.min(axis=1) < 255].astype(float)
    np.testing.assert_allclose(seen[:, 0] / seen[:, 1], 0.5, atol=0.02)
    number = np.round(10.0 * (0.4 * seen[:, 2] / seen[:, 1] - 0.4)).astype(int)
    for i in range(len(sizes)):
        assert 15 < (number == i).sum() < 1500
        faces = len(np.unique(seen[number == i, 1]))
        assert faces <= 3 if i == 0 else faces >= 3  # a box shows no more


def test_rays_show_scaled_meshes_whole():
    """Claim: rays see every triangle of a block that is smaller than it was compiled: from above,
    the picture of a half cylinder is one piece without holes."""
    scene_cfg = SceneConfig(slots=("half_cylinder",), min_blocks=1)
    world = world_model.build(scene_cfg, SimConfig(physics="c"))
    scene = scene_state.parked(scene_cfg.slots)
    scene = scene.replace(position=np.float32([[0.0, 0.0, 0.0125]]), in_play=np.ones(1, bool))
    fields = jax.device_get(world_model.scene_fields(world, scene))
    model = picture.coloured(world, fields, scene)
    data = mujoco.MjData(model)
    data.qpos[world.block_qpos[0]] = [0.0, 0.0, 0.0125, 1.0, 0.0, 0.0, 0.0]
    data.qpos[world.robot_qpos[2]] = 5.0
    mujoco.mj_kinematics(model, data)
    above = Viewpoint(position=(-0.02, 0.0, 0.2), look_at=(0.0, 0.0, 0.0), size=(96, 96))
    drawn = picture.renderer(model, above, None)(data).astype(int)
    seen = np.abs(drawn - drawn[0, 0]).max(axis=2) > 20
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    assert len(rows) > 20
    assert seen[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].mean() > 0.98


def _where(drawn: np.ndarray, channel: int) -> np.ndarray:
    """Mean row and column of the pixels of one colour."""
    pixels = drawn.astype(int)
    seen = pixels[..., channel] > 60 + np.delete(pixels, channel, axis=2).max(axis=2)
    assert seen.sum() > 20
    return np.argwhere(seen).mean(axis=0)


def test_both_ways_of_drawing_agree():
    """Claim: MuJoCo's renderer and its rays show the same to the pixel, under a white sky."""
    command = [sys.executable, "-c", _BOTH]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    if done.returncode == 3:
        pytest.skip("no OpenGL here")
    assert done.returncode == 0, done.stderr
    pictures, skies = json.loads(done.stdout)
    by_mujoco, by_rays = (np.array(image, np.uint8) for image in pictures)
    for channel in (0, 1):
        np.testing.assert_allclose(_where(by_mujoco, channel), _where(by_rays, channel), atol=1.0)
    assert skies == [[255, 255, 255]] * 2


def test_broken_opengl_gives_way_to_rays(monkeypatch: pytest.MonkeyPatch):
    """Claim: where the OpenGL that was found does not draw, the rays do; the probe tells it."""
    assert not gl._draws("nonsense")

    def broken(*_):
        raise RuntimeError("no context")

    monkeypatch.setattr(picture, "_opengl_renderer", broken)
    model = mujoco.MjModel.from_xml_string(BALL)
    assert picture.renderer(model, VIEW, "egl")(mujoco.MjData(model)).shape == (64, 96, 3)


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
def test_choice_of_opengl(monkeypatch: pytest.MonkeyPatch, given, working, chosen):
    """Claim: EGL is tried first, then OSMesa; what the user has set stands."""
    monkeypatch.delenv(gl.VARIABLE, raising=False)
    if given is not None:
        monkeypatch.setenv(gl.VARIABLE, given)
    monkeypatch.setattr(gl, "_draws", working.__contains__)
    assert gl.choose() == chosen
    assert os.environ.get(gl.VARIABLE) == (given or chosen)
