"""The viewer: what its page holds, by MuJoCo and by a client; its window on a virtual display."""

import json
import os
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from csac_jax import cli, presets
from csac_jax.render import gl, viewer
from csac_jax.world import model
from tests.render.test_episode import CUBE

pytestmark = pytest.mark.mjx
WINDOW = """
import contextlib, mujoco, numpy as np
from csac_jax.render import viewer
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><geom type='plane' size='1 1 1'/>"
    "<body><freejoint/><geom size='.05'/></body></worldbody></mujoco>")
poses = [np.array([0, 0, z, 1, 0, 0, 0]) for z in (0.1, 0.2, 0.3)]
seen, window = [], viewer._window
@contextlib.contextmanager
def counted(*of):
    with window(*of) as show:
        yield lambda data, *of: (seen.append(float(data.xpos[1, 2])), show(data, *of))[1]
viewer._window = counted
viewer.play(viewer.Film(model, [("up", poses)]), print, again=False)
print(seen)
"""


@pytest.mark.parametrize("robot", ["hand", "ur5"])
def test_surfaces_are_as_large_as_mujocos(robot: Any):
    """Claim: each geom of the page has the extent that MuJoCo has for it, all of their kinds."""
    pytest.importorskip("viser")
    cfg = presets.get("fast").change(sim={"robot": robot, "physics": "c"})
    world = model.build(cfg.scene, cfg.sim).model
    kinds = set()
    for geom in range(world.ngeom):
        vertices, faces = viewer.mesh(world, geom)
        kinds.add(int(world.geom_type[geom]))
        assert faces.max() < len(vertices)
        if world.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            assert vertices[:, 2].max() == pytest.approx(0.0, abs=1e-9)
            continue
        centre, half = np.split(world.geom_aabb[geom], 2)
        np.testing.assert_allclose(vertices.max(axis=0), centre + half, atol=2e-3)
        np.testing.assert_allclose(vertices.min(axis=0), centre - half, atol=2e-3)
    assert {mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH} < kinds


@pytest.mark.slow
def test_page_follows_the_motion(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys):
    """Claim: `play --viewer` without a display serves a page, whose parts lie where MuJoCo has the
    geoms in every picture; it goes on to the episode of another seed; Ctrl-C ends it."""
    pytest.importorskip("viser")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gl, "has_display", lambda: False)
    monkeypatch.setattr(viewer.time, "sleep", lambda _: None)
    Path("cube.json").write_text(json.dumps({"name": "cube", "blocks": [CUBE]}))
    show, pages, heights, films = viewer.Page.show, [], [], []

    def watched(self: viewer.Page, data: mujoco.MjData, text: str, number: int) -> int:
        following = show(self, data, text, number)
        if isinstance(following, viewer.Film):
            films.append(following.seed)
            raise KeyboardInterrupt
        if not pages:
            address = capsys.readouterr().out.split("open ")[1].split(" in a browser")[0]
            pages.append(urllib.request.urlopen(address, timeout=10).status)
        for geom, part in self.parts.items():
            np.testing.assert_allclose(part.position, data.geom_xpos[geom], atol=1e-6)
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, np.array(part.wxyz))
            np.testing.assert_allclose(turn, data.geom_xmat[geom], atol=1e-6)
        heights.append(float(data.qpos[2]))
        if len(heights) == 30:  # 19 pictures an action: the second time
            self.ask(3)
        return following

    monkeypatch.setattr(viewer.Page, "show", watched)
    assert cli.main(["play", "--scene", "cube.json", "--viewer"]) == 0
    assert pages == [200]
    assert len(set(heights)) > 5
    assert heights[19:] == heights[:11]
    assert films == [3]
    assert capsys.readouterr().out.count("the table is clear") == 1  # the first was read


def test_page_can_be_controlled():
    """Claim: the page shows one picture after the other; it stays while it is paused, goes to a
    chosen picture and begins again on request."""
    viser = pytest.importorskip("viser")
    tiny = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>"
    )
    data, server = mujoco.MjData(tiny), viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        page = viewer.Page(server, viewer.Film(tiny, [("up", np.zeros((9, 0)))]))
        assert page.show(data, "up", 3) == 4
        assert page.picture.value == 3
        page.playing.value = False
        assert page.show(data, "up", 4) == 4
        page.choose(7)
        assert [page.show(data, "up", 4), page.show(data, "up", 7)] == [7, 7]
        page.playing.value = True
        assert page.show(data, "up", 7) == 8
        page.choose(0)
        assert page.show(data, "up", 8) == 0
    finally:
        server.stop()


def test_page_shows_the_scene_of_a_seed():
    """Claim: the page goes to the episode of a chosen seed: its text and its geoms replace those
    before, from the first picture on, and it says so while that is simulated."""
    viser = pytest.importorskip("viser")
    geom = "<geom size='.1'/>"
    worlds = [f"<mujoco><worldbody>{n * geom}</worldbody></mujoco>" for n in (1, 3)]
    one, three = map(mujoco.MjModel.from_xml_string, worlds)
    server, said = viser.ViserServer(host="127.0.0.1", port=0, verbose=False), []

    def another(seed: int) -> viewer.Film:
        said.append(page._text.content)
        return viewer.Film(three, [(f"seed {seed}", np.zeros((5, 0)))], seed)

    try:
        film = viewer.Film(one, [("first", np.zeros((9, 0)))], seed=4)
        page = viewer.Page(server, film, another=another)
        assert (page.seed.value, page.picture.max, list(page.parts)) == (4, 8, [0])
        page.ask(7)
        film = page.show(film.data, film.move(3), 3)
        assert said == ["simulates the episode of seed 7"]
        assert (page.picture.max, list(page.parts)) == (4, [0, 1, 2])
        assert page.show(film.data, film.move(0), 0) == 1
        assert page._text.content == "seed 7"
    finally:
        server.stop()


@pytest.mark.slow
def test_window_shows_every_pose():
    """Claim: where there is a display, MuJoCo's window opens and gets each pose."""
    if shutil.which("Xvfb") is None:
        pytest.skip("no Xvfb here")
    read, write = os.pipe()
    xvfb = ["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24"]
    with subprocess.Popen(xvfb, pass_fds=[write], stderr=subprocess.DEVNULL) as server:
        try:
            display = f":{os.read(read, 16).decode().strip()}"
            env = os.environ | {"DISPLAY": display, "MUJOCO_GL": "glfw"}
            command = [sys.executable, "-c", WINDOW]
            done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=100)
        finally:
            server.terminate()
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().endswith("[0.1, 0.2, 0.3]")
